"""Predictions of closer looks from an observation model and miss rates alone, without learned evidence."""

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check
from semfov.observation.foveal import FovealObservationModel
from semfov.zoom.eye import WindowEye
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.survey import STEPS


class ObservedRates:
    r"""Expected number of objects that closer looks find, by an observation model whose levels are magnifications.

    A cell x whose hints have scores S in a look of octave d holds class t with the calibrated probability
    :math:`P(t \mid S, d)`. For a cell without hints the probability follows from the miss rates m and from the shares π
    of cells that hold each class:

    .. math:: P(t \mid \text{nothing}, d) = \frac{\pi_t \, m_{td}}{\sum_k \pi_k \, m_{kd}}

    The sum includes background. A look of octave d' is expected to find this number of new objects:

    .. math:: \lambda_{d'}(x) = P(t \in x) \, (1 - m_{td'})

    It can take the place of `GlimpseEvidence` in `ZoomBelief` and `find_everything`, for comparison. It does not use
    relations between classes or between places of a picture.

    Args:
        model: observation model that was fitted on mosaics (`python -m train.fit_fom --mosaics N`).
        lattice: lattice of the picture.
        foresight: share of what still closer looks would find in a window that counts towards its value.

    Raises:
        InputError: the model has no miss rates, or no counts of the cells that hold each class.
    """

    def __init__(self, model: FovealObservationModel, lattice: Lattice, *, foresight: float = 0.35) -> None:
        has_counts = model.miss_rate is not None and "cells" in model.metadata
        check(has_counts, "model", "one that train.fit_fom fitted with --mosaics", "one without counts of cells")
        self.model = model
        self.lattice = lattice
        self.foresight = foresight
        counts = torch.tensor(model.metadata["cells"], dtype=torch.float32) + 1
        self.share = counts / counts.sum()

    @torch.no_grad()
    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor:
        """As `GlimpseEvidence.rates`, but without the rates of earlier looks."""
        octaves = self.lattice.octaves
        held = self._held(look, octaves[look.level])  # (rows, columns, K)
        rates = torch.zeros(len(targets), STEPS, *look.scores.shape[:2])
        for step in range(min(STEPS, len(octaves) - 1 - look.level)):
            detection_rate = 1 - self.model.miss_likelihood(octaves[look.level + 1 + step])[1:]
            new = held * detection_rate
            with_any = torch.cat([new.sum(-1, keepdim=True), new], -1)  # target 0 is any class
            rates[:, step] = with_any[..., targets].movedim(-1, 0)
        return (rates + 1e-9).log()

    def _held(self, look: Gist, octave: Tensor) -> Tensor:
        """Compute the expected number of undetected objects of each class in the cells, `(rows, columns, K)`."""
        scores = look.scores / look.scores.sum(-1, keepdim=True).clamp(min=1)
        background = 1 - scores.sum(-1, keepdim=True)
        vectors = torch.cat([background, scores], -1).clamp(min=0)
        with_hints = self.model.calibrate(vectors, octave.expand(vectors.shape[:-1]))
        joint = self.share * self.model.miss_likelihood(octave)
        without_hints = joint / joint.sum()
        has_hints = (look.scores > 0).any(-1, keepdim=True)
        probability = torch.where(has_hints, with_hints, without_hints)[..., 1:]
        # The gist marks the cell of an object's centre; the object also covers the cells around it.
        detected = F.max_pool2d(look.found.float().movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1)
        return probability * (1 - detected) * look.scale**2

    def taper(self, span: int) -> Tensor:
        """Weights of the cells along a side of a window, `(span,)`: ones."""
        return torch.ones(span)


def make_zoom_observation(name: str | None, eye: WindowEye) -> FovealObservationModel | None:
    """Load an observation model by magnification, by name or the one shipped for the eye; None if none is shipped."""
    if name is None:
        name = f"{eye.detector.name}-zoom"
        if not (FovealObservationModel.shipped / f"{name}.safetensors").is_file():
            return None
    model = FovealObservationModel.from_pretrained(name)
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)
