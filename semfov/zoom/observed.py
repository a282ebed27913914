"""What looks say of closer ones by the observation model and the miss rates alone, without learned evidence."""

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check
from semfov.observation.foveal import FovealObservationModel
from semfov.zoom.gist import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.networks import STEPS


class ObservedRates:
    r"""Expected finds of closer looks, by an observation model whose levels are magnifications.

    A cell x whose hints have scores S in a look of octave d holds class t with the calibrated probability
    :math:`P(t \mid S, d)`; one without hints, by the miss rates m and the shares π of the cells that hold each class,
    with

    .. math:: P(t \mid \text{nothing}, d) = \frac{\pi_t \, m_{td}}{\sum_k \pi_k \, m_{kd}}

    (background among the classes). A look of octave d' finds what was not found yet with

    .. math:: \lambda_{d'}(x) = P(t \in x) \, (1 - m_{td'})

    It stands where `GlimpseEvidence` does in `ZoomBelief` and `find_everything`, for comparison: what the classes and
    the places of a picture tell of each other is not in it.

    Args:
        model: fitted on mosaics (`python -m train.fit_fom --mosaics N`).
        lattice: of the picture.
        foresight: as for `GlimpseEvidence`.

    Raises:
        InputError: the model has no miss rates, or does not know how many cells hold a class.
    """

    def __init__(self, model: FovealObservationModel, lattice: Lattice, *, foresight: float = 0.35) -> None:
        fitted = model.miss_rate is not None and "cells" in model.metadata
        check(fitted, "model", "one that train.fit_fom fitted with --mosaics", "one without counts of cells")
        self.model, self.lattice, self.foresight = model, lattice, foresight
        counts = torch.tensor(model.metadata["cells"], dtype=torch.float32) + 1
        self.share = counts / counts.sum()

    @torch.no_grad()
    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor:
        """As `GlimpseEvidence.rates`; what earlier looks said plays no part."""
        octaves = self.lattice.octaves
        here = octaves[look.level]
        scores = look.scores / look.scores.sum(-1, keepdim=True).clamp(min=1)
        seen = torch.cat([1 - scores.sum(-1, keepdim=True), scores], -1).clamp(min=0)
        told = self.model.calibrate(seen, here.expand(seen.shape[:-1]))
        unseen = self.share * self.model.miss_likelihood(here)
        held = torch.where((look.scores > 0).any(-1, keepdim=True), told, unseen / unseen.sum())[..., 1:]
        # An object lies about its centre, where the gist has it.
        known = F.max_pool2d(look.found.float().movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1)
        held = held * (1 - known) * look.scale**2
        rates = torch.zeros(len(targets), STEPS, *look.scores.shape[:2])
        for step in range(min(STEPS, len(octaves) - 1 - look.level)):
            new = held * (1 - self.model.miss_likelihood(octaves[look.level + 1 + step])[1:])
            rates[:, step] = torch.cat([new.sum(-1, keepdim=True), new], -1)[..., targets].movedim(-1, 0)
        return (rates + 1e-9).log()

    def taper(self, span: int) -> Tensor:
        """Every cell of a window counts alike, `(span,)`."""
        return torch.ones(span)
