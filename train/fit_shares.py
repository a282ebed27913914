"""How often the targets of a fit's searches were there: `python -m train.fit_shares` writes it into a fitted model.

    python -m train.fit_shares --data.root DIR --data.annotations instances.json --windows FILE

The photographs are those that the evidence for windows was fitted to. The shares follow from the rule by which a fit
draws its searches; looks at the photographs `looked`, one pass each, correct them by class. Fits write the shares
themselves, so this is for models that were fitted without them. The Brier score that is printed is that of searches of
the photographs looked at for each of the commonest classes, with its share of these photographs as `prior`; each half
of them has the correction of the other half.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from semfov.belief.prior import with_prior
from semfov.data.scene import Scenes
from semfov.errors import InputError, check
from semfov.fit.photographs import measured_shares, shares_by_frequency
from semfov.fit.settings import FitConfig
from semfov.fit.zoom_store import StoredWindowLooks
from semfov.runs.command import command
from semfov.runs.config import DataConfig
from semfov.runs.progress import track
from semfov.runs.setup import make_detector, make_scenes
from semfov.zoom.evidence import GlimpseEvidence, PhotographEvidence
from semfov.zoom.eye import WindowEye
from semfov.zoom.looks import Window

_COMMONEST = 10  # number of classes whose probabilities are judged


@dataclass(frozen=True)
class FitSharesConfig(FitConfig):
    """Write the shares of the searches of a fit into its model.

    Args:
        data: the photographs from whose classes the searches of the fit were drawn.
        windows: file of evidence for windows.
        looked: the photographs that evidence for windows was fitted to.
    """

    unused = ("sensor", "seed", "name")
    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=2, max_target_area=None))
    windows: Path | None = None
    looked: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    out: Path = Path("runs/fit_shares")


@torch.inference_mode()
def _whole_looks(eye: WindowEye, scenes: Scenes) -> tuple[Tensor, Tensor]:
    """Look at whole photographs; returns the highest scores, and the classes that the photographs hold, `(P, K)`."""
    scores = []
    held = torch.zeros(len(scenes), len(scenes.classes), dtype=torch.bool)
    for index in track(range(len(scenes)), "looking at photographs", "photograph"):
        source = StoredWindowLooks(eye, scenes, index, None)
        scores.append(source.see([Window.overview(source.lattice)])[0].show)
        held[index, scenes.annotation(index).labels - 1] = True
    return torch.stack(scores), held


def fit_shares(config: FitSharesConfig) -> None:
    """Write the shares, and print their range."""
    if config.windows is None:
        raise InputError("windows: expected the file of evidence for windows, got none")
    detector = make_detector(config.detector)
    scenes = make_scenes(config.data, detector.classes)
    looked = make_scenes(config.looked, detector.classes)
    _write_windows(config.windows, scenes, looked, WindowEye(detector).eval().requires_grad_(False))


def _write_windows(path: Path, scenes: Scenes, looked: Scenes, eye: WindowEye) -> None:
    """Write the shares into evidence for windows, corrected by looks at the photographs that it was fitted to."""
    model = GlimpseEvidence.from_pretrained(path)
    photograph = model.photograph
    check(photograph is not None, "windows", "evidence with that for photographs", path)
    assert photograph is not None
    drawn = shares_by_frequency(photograph.usual, scenes)
    scores, held = _whole_looks(eye, looked)
    photograph.shares = measured_shares(photograph, scores, held, drawn)
    model.save(path)
    print(f"{path}: {_span(photograph.shares)}")
    before, after = _held_out_brier(photograph, scores, held, drawn)
    print(f"Brier score of the {_COMMONEST} commonest classes: {before:.4f} by frequency, {after:.4f} corrected")


@torch.inference_mode()
def _held_out_brier(evidence: PhotographEvidence, scores: Tensor, held: Tensor, drawn: Tensor) -> tuple[float, float]:
    """Judge shares by halves of the photographs, each with the shares that the other half gives.

    Args:
        evidence: the evidence for photographs.
        scores: `(P, K)`, highest ones in the looks at the whole.
        held: `(P, K)` boolean, the classes of each photograph.
        drawn: `(K,)`, the shares by frequency.

    Returns:
        The Brier scores with the shares by frequency, and with corrected ones.
    """
    common = held.sum(0).argsort(descending=True)[:_COMMONEST]
    priors = (held.sum(0) + 0.5) / (len(held) + 1)
    log_odds = evidence.presence(scores, torch.arange(scores.shape[-1]).expand(scores.shape) + 1)
    is_first = torch.arange(len(held)) % 2 == 0
    errors = []
    for half in (is_first, ~is_first):
        corrected = measured_shares(evidence, scores[~half], held[~half], drawn)
        for shares in (drawn, corrected):
            wrong = [
                with_prior(log_odds[half, number], float(priors[number]), float(shares[number])).sigmoid()
                - held[half, number].float()
                for number in common.tolist()
            ]
            errors.append(float(torch.stack(wrong).square().mean()))
    return (errors[0] + errors[2]) / 2, (errors[1] + errors[3]) / 2


def _span(shares: Tensor) -> str:
    """Write the least and the largest share in words."""
    return f"the target was there in {float(shares.min()):.3f} to {float(shares.max()):.3f} of the searches for a class"


main = command(fit_shares, FitSharesConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
