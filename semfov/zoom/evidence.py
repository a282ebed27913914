"""Learned evidence by magnification: predictions from a look at a window of what closer looks at its parts show."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.belief.evidence import neighbourhood_peak, network
from semfov.belief.prior import SHARES
from semfov.belief.target_evidence import THRESHOLDS, Thresholds
from semfov.belief.verification import CLOSER_FEATURES, Verification
from semfov.errors import check, check_number, check_whole
from semfov.io.compatibility import check_same_detector
from semfov.io.pretrained import Pretrained
from semfov.io.schema import Array, Field, Maybe, Number, Object, Schema, perceptron
from semfov.sensor.lines import constant
from semfov.zoom.certainty import Certainty
from semfov.zoom.closer import USUAL_WINDOW
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice

STEPS = 3  # largest number of octaves between a look and the closer looks that are predicted from it
_CROWD = 9  # side in cells of the square over which the networks read the mean of the strongest hints

_FLOOR = 1e-4

_CHANNELS, _WIDTH = 8, 48
_HINTS, _MEMORY = 11, 2
_NEAR, _WIDE = 5, (_CROWD, 17)
"""Sides in cells of the squares over which sums of hints are averaged: the neighbours, and the surroundings."""
_INPUTS = _HINTS + _MEMORY + 2 * _CHANNELS + len(_WIDE) * (_CHANNELS + 2)
_LOWEST = -0.8  # about the feature of a score of 0
_LARGEST = 1e6


def features(scores: Tensor) -> Tensor:
    """Logarithms of scores, shifted and scaled to about [-1, 1.5]."""
    return (scores + _FLOOR).log().mul_(0.25).add_(1.5)


def _hint_maps(own: Tensor, best: Tensor, detections: Tensor, size: Tensor, crowd: Tensor) -> list[Tensor]:
    """Maps `(T, rows, columns)` of one look: hints, detections and sizes of objects in and around each cell."""
    # One call for the peaks of both: after a pass of the detector a call costs more than the work in it.
    peak, near = neighbourhood_peak(torch.cat([own, detections]), 3).chunk(2)
    hints = [own, best, peak, neighbourhood_peak(peak, 7), _neighbourhood_mean(own, 5), crowd]
    sizes = [size / 4 - 1, (size > 0).to(own)]
    return [each.expand(own.shape) for each in (*hints, *sizes, detections, near, own.amax((-1, -2), keepdim=True))]


def _memory_maps(own: Tensor, before: Tensor | None) -> list[Tensor]:
    """What an earlier, coarser look predicted for each cell, and whether there was one, two maps like `own`."""
    prediction = torch.full_like(own, -1.0) if before is None else before / 4
    return [prediction, torch.full_like(own, float(before is not None))]


def _tapered(border: Tensor, span: int) -> Tensor:
    """Weights `(span,)` of the cells along a side of a window, from four learned ones `(4,)` from border to middle."""
    cell = torch.arange(span, device=border.device)
    ring = torch.minimum(cell, span - 1 - cell) * 8 // span
    return border.sigmoid()[ring.clamp(max=3)]


def _neighbourhood_mean(values: Tensor, side: int) -> Tensor:
    """Mean of maps `(T, rows, columns)` over the square about each cell; what lies beyond the map counts as 0."""
    # Products with banded matrices take a tenth of the time of `avg_pool2d`.
    down, across = (_band(length, side, values.dtype, values.device) for length in values.shape[-2:])
    return down @ values @ across


@constant
def _band(length: int, side: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix `(length, length)` whose product with a line takes the mean over `side` neighbours."""
    place = torch.arange(length, device=device)
    return ((place[:, None] - place).abs() <= side // 2).to(dtype) / side


def _through(network: nn.Sequential, values: Tensor, outputs: slice | None = None) -> Tensor:
    """Compute selected outputs of a network without calls of modules, which cost most of the time in one so small."""
    last = len(network) - 1
    for place, layer in enumerate(network):
        if isinstance(layer, nn.Linear):
            if outputs is None or place < last:
                values = F.linear(values, layer.weight, layer.bias)
            else:
                values = F.linear(values, layer.weight[outputs], layer.bias[outputs])
        elif isinstance(layer, nn.GELU):
            # torch gives contiguous arrays to oneDNN, whose call is slow: transposed matrices and repeated vectors.
            values = F.gelu(values.expand(2, -1))[0] if values.ndim == 1 else F.gelu(values.mT).mT
        elif layer.training:  # dropout
            values = layer(values)
    return values


class Survey(nn.Module):
    r"""Predicts how many objects of any class closer looks find, :math:`E[n(w)] = \sum_{x \in w} r(x) \lambda(x)`."""

    def __init__(self, classes: int, *, foresight: float = 0.35) -> None:
        super().__init__()
        self.foresight = foresight
        self.mix = nn.Linear(classes, _CHANNELS, bias=False)
        nn.init.normal_(self.mix.weight, std=0.3)
        self.rate = network(_INPUTS, _WIDTH, STEPS)
        self.border = nn.Parameter(torch.tensor([0.0, 1.0, 2.0, 2.0]))

    def rates(self, look: Gist, targets: Tensor | None = None, before: Tensor | None = None) -> Tensor:
        """Log numbers `(1, 3, rows, columns)` of objects that only closer looks find; before `(1, rows, columns)`."""
        hints, best = features(look.scores), features(look.best)
        # torch takes twice as long for `any` of booleans, and for a matrix of few columns on the right.
        detections = look.found.to(best).amax(-1)
        mix = self.mix.weight
        kinds = torch.addmm(-_LOWEST * mix.sum(1, keepdim=True), mix, hints.flatten(0, 1).mT).unflatten(1, best.shape)
        around = torch.cat([kinds, best[None], detections[None]])
        surroundings = [_neighbourhood_mean(around, side) for side in _WIDE]
        crowd = surroundings[_WIDE.index(_CROWD)][_CHANNELS]
        best_maps = [
            *_hint_maps(best[None], best, detections[None], look.size, crowd),
            *_memory_maps(best[None], before),
        ]
        maps = torch.cat([*best_maps, kinds, _neighbourhood_mean(kinds, _NEAR), *surroundings])
        value = _through(self.rate, maps.movedim(0, -1)) - 6
        return value.clamp(max=3).movedim(-1, 0)[None]

    def taper(self, span: int) -> Tensor:
        """Weights r of the cells along a side of a window; objects at its border are cut; → `(span,)`."""
        return _tapered(self.border, span)


class PhotographEvidence(nn.Module):
    r"""Whether a photograph holds a class, by the highest score s of a hint and the share q of photographs.

    .. math:: \operatorname{logit} P(t) = a \operatorname{logit} s + b \operatorname{logit} q_t + c

    `verification`, `certainty` and the `window` of a closer look are those of photographs; usual `(K,)` is logit q.
    shares `(K,)` are those of the searches of the fit whose target was there (`semfov.belief.prior`); None: not known.
    """

    usual: Tensor
    shares: Tensor | None

    def __init__(
        self,
        classes: int,
        *,
        thresholds: Thresholds | None = None,
        certainty: Certainty | None = None,
        window: tuple[float, float] = USUAL_WINDOW,
        shares: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.window = window
        self.register_buffer("usual", torch.zeros(classes))
        self.register_buffer("shares", shares)
        self.whole = nn.Linear(2, 1)
        self.verification = Verification(thresholds=thresholds)
        self.certainty = certainty

    def presence(self, best: Tensor, target: Tensor) -> Tensor:
        """Log odds that the photograph holds classes 1..K, by their highest scores; shapes `(...)`."""
        return self.whole(torch.stack([best.logit(1e-4), self.usual[target - 1]], -1))[..., 0]


_SUMMARY = 3
_SHAPE, _SHAPE_WIDTH = 7, 24
_RATE, _RATE_WIDTH = 14, 32
CASE, _JUDGE_WIDTH = 10, 16
"""Number of facts of a search from which the presence of its target is predicted (`semfov.zoom.decision`)."""


_VERIFIED = {"verification.linear.weight": (2, CLOSER_FEATURES), "verification.linear.bias": (2,)}
_OWN = {"usual": ("K",), "whole.weight": (1, 2), "whole.bias": (1,), **_VERIFIED}  # of photographs


class GlimpseEvidence(Pretrained):
    r"""Predicts from a look at a window what looks at its parts show that are one to three octaves closer.

    It answers two questions about a part w of the window and a class t, and one about the whole picture. Small
    networks answer them. They are fitted on mosaics of photographs with annotated boxes.

    - Does a closer look at w show t with a score of 0.3 or more (`detector.least`)? The log odds depend on the
      strongest hint of t in w, and on that of every other class, because some classes occur together:

      .. math:: \operatorname{logit} P(t \in w) = a_t \phi_t(w) + b_t + f_t(\phi(w)) + g(\phi_t(w), \ldots), \qquad
                \phi_k(w) = \ln(\max_{x \in w} s_k(x) + \epsilon)

    - How many objects of t does it find that were not found before? The expected number is a sum over cells. Its
      weights fall off towards the border of w, which cuts objects that lie there:

      .. math:: E[n(w)] = \sum_{x \in w} r(x) \lambda(x)

    - Does the picture hold t at all, after the looks of a search? The highest score of t in any look, :math:`s^*`, is
      corrected by further facts about the search, its case c (`semfov.zoom.decision`):

      .. math:: \operatorname{logit} P(t) = \operatorname{logit} s^* + j(c)

    Here f, g, λ and j are networks. Another network predicts how many objects of any class a look finds (`survey`). Two
    logistic regressions give the probabilities after a closer look at a place that seems to hold t (`verification`).

    Args:
        classes: number of classes of the detector, without background.
        width: number of hidden units of f.
        patience: a coarse window is looked at before the best closer one when the closer windows in it promise this
            many times as many hits together.
        foresight: share of what still closer looks would find in a window that counts towards its value.
        thresholds: thresholds at which searches decide; None where none were chosen.
        verification: probabilities after closer looks; None decides searches without them.
        certainty: probability that an object is there; None where it was not fitted.
        photograph: evidence for photographs; None where it was not fitted.
        metadata: JSON values kept with the model.

    Raises:
        InputError: a setting is outside its range.

    >>> evidence = GlimpseEvidence(classes=3, width=8)
    >>> evidence.presence(torch.rand(5, 3), torch.rand(5, 3), torch.ones(5)).shape
    torch.Size([5, 3])
    >>> evidence.taper(8).shape
    torch.Size([8])
    """

    kind: ClassVar[str] = "glimpse-evidence"
    title: ClassVar[str] = "model of evidence by magnification"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    schema: ClassVar[Schema] = Schema(
        {
            "slope": Field(("K",), low=-_LARGEST, high=_LARGEST),
            "offset": Field(("K",), low=-_LARGEST, high=_LARGEST),
            "company.0.weight": Field(("W", f"K+{_SUMMARY + 1}"), low=-_LARGEST, high=_LARGEST),
            "company.0.bias": Field(("W",), low=-_LARGEST, high=_LARGEST),
            "company.3.weight": Field(("K", "W"), low=-_LARGEST, high=_LARGEST),
            "company.3.bias": Field(("K",), low=-_LARGEST, high=_LARGEST),
            **perceptron("shape", _SHAPE, _SHAPE_WIDTH),
            **perceptron("rate", _RATE, _RATE_WIDTH, STEPS),
            **perceptron("judge", CASE, _JUDGE_WIDTH),
            "prior": Field(("K+1", 2), low=-1e3, high=1e3),
            "border": Field((4,), low=-1e3, high=1e3),
            "survey.mix.weight": Field((_CHANNELS, "K"), low=-_LARGEST, high=_LARGEST),
            **perceptron("survey.rate", _INPUTS, _WIDTH, STEPS),
            "survey.border": Field((4,), low=-1e3, high=1e3),
            **{name: Field(shape, low=-1e3, high=1e3, optional=True) for name, shape in _VERIFIED.items()},
            **{f"photograph.{name}": Field(shape, low=-1e3, high=1e3, optional=True) for name, shape in _OWN.items()},
            "photograph.shares": SHARES,
        },
        {
            "classes": Number(size="K"),
            "width": Number(size="W"),
            "patience": Number(above=0, high=_LARGEST),
            "foresight": Number(0, 1),
            "thresholds": THRESHOLDS,
            "survey": Object({"foresight": Number(0, 1)}),
            "verification": Maybe(Object({"thresholds": THRESHOLDS}, required=("thresholds",))),
            "certainty": Maybe(Array(Number(low=-_LARGEST, high=_LARGEST))),
            "photograph": Maybe(
                Object(
                    {
                        "thresholds": THRESHOLDS,
                        "certainty": Maybe(Array(Number(low=-_LARGEST, high=_LARGEST))),
                        "window": Array((Number(above=0, high=1), Number(1, _LARGEST))),
                    }
                )
            ),
        },
    )

    def __init__(
        self,
        classes: int = 80,
        width: int = 64,
        *,
        patience: float = 2.3,
        foresight: float = 0.35,
        thresholds: Thresholds | None = None,
        verification: Verification | None = None,
        certainty: Certainty | None = None,
        photograph: PhotographEvidence | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        check_whole(classes, "classes", 1, 100_000)
        check_whole(width, "width", 1, 100_000)
        check(patience > 0, "patience", "a number above 0", patience)
        check_number(foresight, "foresight", 0, 1)
        self.classes, self.width = classes, width
        self.patience, self.foresight, self.thresholds = patience, foresight, thresholds
        self.metadata = dict(metadata or {})
        self.slope = nn.Parameter(torch.full((classes,), 2.0))
        self.offset = nn.Parameter(torch.full((classes,), -2.0))
        self.company = nn.Sequential(
            nn.Linear(classes + _SUMMARY + 1, width), nn.GELU(), nn.Dropout(0.4), nn.Linear(width, classes)
        )
        self.shape = network(_SHAPE, _SHAPE_WIDTH)
        self.rate = network(_RATE, _RATE_WIDTH, STEPS)
        self.judge = network(CASE, _JUDGE_WIDTH)
        with torch.no_grad():
            # Until the network is fitted, the best score is the probability.
            for parameter in self.judge[-1].parameters():
                parameter.zero_()
        self.prior = nn.Parameter(torch.zeros(classes + 1, 2))
        self.border = nn.Parameter(torch.tensor([0.0, 1.0, 2.0, 2.0]))
        self.survey = Survey(classes, foresight=foresight)
        self.verification = verification
        self.certainty = certainty
        self.photograph = photograph

    def presence(
        self, scores: Tensor, summary: Tensor, steps: Tensor, target: int | None = None, before: Tensor | None = None
    ) -> Tensor:
        """Predict whether a closer look at a window shows a class with a score of 0.3 or more.

        Args:
            scores: `(N, K)`, strongest hint of each class in each window (`pool`).
            summary: `(N, 3)`, summary of all hints in each window (`pool`).
            steps: `(N,)`, octaves between the look and the closer one.
            target: class 1..K; None for all.
            before: log odds that an earlier, coarser look gave for the same windows, in the shape of the result; None
                for a first look.

        Returns:
            Log odds, `(N,)`, or `(N, K)` for all classes.
        """
        odds = self.odds(self.hint_facts(scores, summary, steps, target), before)
        return odds if target is None else odds[:, 0]

    def hint_facts(self, scores: Tensor, summary: Tensor, steps: Tensor, target: int | None = None) -> Tensor:
        """Compute the part of `presence` that does not depend on earlier looks.

        Args:
            scores: `(N, K)`, as for `presence`.
            summary: `(N, 3)`, as for `presence`.
            steps: `(N,)`, as for `presence`.
            target: class 1..K; None for all.

        Returns:
            `(N, 1, 6)`, or `(N, K, 6)` for all classes: five inputs of the network g, and the sum of all terms of the
            log odds but g.
        """
        hints = features(scores)
        octaves = (steps[:, None] - 1.5).to(hints)
        crowd = (summary + 0.01).log() / 3
        inputs = torch.cat([hints, crowd, octaves], -1)
        own, slope, offset, one = hints, torch.as_tensor(self.slope), torch.as_tensor(self.offset), None
        if target is not None:
            one = slice(target - 1, target)
            own, slope, offset = own[:, one], slope[one], offset[one]
        value = slope * own + offset + _through(self.company, inputs, one)
        top = hints.amax(-1, keepdim=True).expand_as(own)
        facts = [own, top, own - top, octaves.expand_as(own), crowd[:, 2:].expand_as(own), value]
        return torch.stack(facts, -1)

    def odds(self, facts: Tensor, before: Tensor | None = None) -> Tensor:
        """Complete `presence` by the log odds of an earlier look.

        Args:
            facts: `(..., 6)`, from `hint_facts`.
            before: `(...)`, log odds that an earlier, coarser look gave for the same windows; None for a first look.

        Returns:
            `(...)`, log odds.
        """
        own = facts[..., :1]
        earlier = torch.zeros_like(own) if before is None else before.view_as(own) / 3
        inputs = torch.cat([facts[..., :5], earlier, torch.full_like(own, float(before is not None))], -1)
        return facts[..., 5] + _through(self.shape, inputs)[..., 0]

    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor:
        """Predict how many objects centred in each cell closer looks find that this look did not.

        Args:
            look: the look.
            targets: `(T,)`, classes 1..K; rates for any class are those of `survey`.
            before: `(T, rows, columns)`, logarithms of the rates that an earlier, coarser look gave for looks one
                octave closer than this one; None for a first look.

        Returns:
            `(T, 3, rows, columns)`, logarithms of the expected numbers, for looks one, two and three octaves closer.

        Raises:
            InputError: a target is no class.
        """
        if not torch.compiler.is_compiling():
            classes = targets.tolist()
            check(min(classes) >= 1, "targets", "classes from 1 on", classes)
        columns = targets - 1
        scores = torch.cat([look.best[..., None], look.scores.index_select(-1, columns)], -1)
        hints = features(scores.movedim(-1, 0))
        best, own = hints[0], hints[1:]
        detections = look.found.index_select(-1, columns).movedim(-1, 0).to(own)
        usual, bias = self.prior.index_select(0, targets).mT[..., None, None]
        crowd = _neighbourhood_mean(best[None], _CROWD)[0]
        maps = [*_hint_maps(own, best, detections, look.size, crowd), usual.expand_as(own), *_memory_maps(own, before)]
        return (_through(self.rate, torch.stack(maps, -1)) + (bias[..., None] - 6)).clamp(max=3).movedim(-1, 1)

    def anywhere(self, best: Tensor, case: Tensor) -> Tensor:
        """Predict whether the picture holds a class, after the looks of a search.

        Args:
            best: `(...)`, highest score of the class in any look.
            case: `(..., 10)`, further facts about the search (`semfov.zoom.decision.SearchFacts.case`).

        Returns:
            Log odds, `(...)`.
        """
        return torch.logit(best, eps=1e-4) + _through(self.judge, case)[..., 0]

    def taper(self, span: int) -> Tensor:
        """Weights r of the cells along a side of a window; objects at its border are cut.

        Args:
            span: number of cells along the side.

        Returns:
            `(span,)`, from 0 to 1.
        """
        return _tapered(self.border, span)

    def certainty_in(self, lattice: Lattice) -> Certainty | None:
        """Choose the certainty of a picture.

        Args:
            lattice: lattice of the picture.

        Returns:
            The probability that an object is there, in a photograph or in a larger picture; None where none was fitted.
        """
        return self.photograph.certainty if self.photograph and lattice.levels == 1 else self.certainty

    def check_compatible(self, settings: Mapping[str, Any]) -> None:
        """Raise `InputError` for another detector than the evidence was fitted for.

        Args:
            settings: `WindowEye.settings()`.
        """
        check_same_detector(self.metadata.get("detector", {}), settings["detector"], self.title)

    def _record(self) -> dict[str, Any]:
        verified, own = self.verification, self.photograph
        at = own and own.verification.thresholds
        return {
            **{name: getattr(self, name) for name in ("classes", "width", "patience", "foresight")},
            "thresholds": self.thresholds and asdict(self.thresholds),
            "survey": {"foresight": self.survey.foresight},
            "verification": verified and {"thresholds": verified.thresholds and asdict(verified.thresholds)},
            "certainty": self.certainty and self.certainty.numbers,
            "photograph": own
            and {
                "thresholds": at and asdict(at),
                "certainty": own.certainty and own.certainty.numbers,
                "window": list(own.window),
            },
        }

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        verified, own = record.get("verification"), record.get("photograph")
        least, context = (own or {}).get("window", USUAL_WINDOW)
        model = cls(
            **{name: record[name] for name in ("classes", "width", "patience", "foresight", "metadata")},
            **_chosen(record),
            verification=verified and Verification(thresholds=_chosen(verified)["thresholds"]),
            photograph=own
            and PhotographEvidence(
                record["classes"],
                **_chosen(own),
                window=(least, context),
                shares=tensors.get("photograph.shares"),
            ),
        )
        model.survey.foresight = record["survey"]["foresight"]
        model.load_state_dict(tensors)
        return model


def _chosen(record: Mapping[str, Any]) -> dict[str, Any]:
    """The thresholds and the certainty in a record."""
    at, certainty = record["thresholds"], record.get("certainty")
    return {"thresholds": at and Thresholds(**at), "certainty": None if certainty is None else Certainty.of(certainty)}


def pool(scores: Tensor, box: tuple[int, int, int, int]) -> tuple[Tensor, Tensor]:
    """Pool the hints in a window of cells; scores `(rows, columns, K)` → `(K,)`."""
    x1, y1, x2, y2 = box
    cells = scores[max(y1, 0) : y2, max(x1, 0) : x2].flatten(0, 1)
    best = cells.amax(-1)
    return cells.amax(0), torch.stack([best.sum(), (best > 0).to(best).mean(), (best > 0.02).to(best).sum()])


def pool_spans(scores: Tensor, spans: Sequence[int]) -> list[tuple[Tensor, Tensor]]:
    """`pool` for all windows of several sizes, `(down, across, K)`; each size is pooled from the next smaller one."""
    best = scores.amax(-1)
    maps = torch.stack([best, (best > 0).to(best), (best > 0.02).to(best)])
    by_span: dict[int, tuple[Tensor, Tensor]] = {}
    top, have = scores, (1, 1)
    for span in sorted(spans):
        size = min(span, scores.shape[0]), min(span, scores.shape[1])
        for axis in (0, 1):
            top = _slide(top, axis, size[axis], have[axis])
        have = size
        # A product of matrices would be faster, but not right after a pass of the detector.
        means = F.avg_pool2d(F.avg_pool2d(maps, (size[0], 1), 1), (1, size[1]), 1)
        total, hinted, clear = (means * (size[0] * size[1])).unbind()
        by_span[span] = top, torch.stack([total, hinted / (size[0] * size[1]), clear], -1)
    return [by_span[span] for span in spans]


def _slide(values: Tensor, axis: int, width: int, have: int = 1) -> Tensor:
    """Largest of every `width` neighbours along an axis, given the largest of every `have`, by doubling windows."""
    while have < width:
        step = min(have, width - have)
        length = values.shape[axis] - step
        values = torch.maximum(values.narrow(axis, 0, length), values.narrow(axis, step, length))
        have += step
    return values
