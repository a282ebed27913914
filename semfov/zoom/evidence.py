r"""Learned evidence by magnification: predictions from a look at a window of what closer looks at its parts find.

- `rates` gives λ(x), the expected number of new objects of a class in each cell x, from maps of the hints around it.
- `presence` gives the log odds that the picture holds a class, from the expected number of its objects.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from semfov.errors import check, check_number, check_whole
from semfov.io.compatibility import Settings, check_same_detector
from semfov.io.pretrained import Pretrained
from semfov.io.schema import Array, Field, Maybe, Number, Object, Schema, perceptron
from semfov.observation.presence import SHARES
from semfov.observation.thresholds import THRESHOLDS, DecidingModule, Thresholds, thresholds_of, thresholds_record
from semfov.precision import without_autocast
from semfov.zoom.certainty import Certainty
from semfov.zoom.closer import USUAL_WINDOW
from semfov.zoom.hint_maps import CROWD, features, hint_maps, memory_maps, neighbourhood_mean, tapered, through
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.networks import network
from semfov.zoom.survey import STEPS, Survey

_LARGEST = 1e6

_FEWEST = 0.001  # expected number of objects ε that is added, so that none has a logarithm

# Inputs and hidden units of the network λ.
_RATE = 14
_RATE_WIDTH = 32


class PhotographEvidence(DecidingModule):
    r"""Whether a photograph holds a class, by the highest score s of a hint and the share q of photographs, and where.

    .. math:: \operatorname{logit} P(t) = a \operatorname{logit} s + b \operatorname{logit} q_t + c

    With the certainty p of an object (`Certainty`), which is right if its box is, a search finds its target there with

    .. math:: \operatorname{logit} P(\text{place}) = a' \operatorname{logit} p + c'

    since it looks for one object where others may be, and half of its targets are there.

    Attributes:
        usual: `(K,)`, logit q.
        shares: `(K,)`, by class the share of the searches of the fit whose target was there (`semfov.belief.prior`);
            None if not known.
        whole: the logistic regression of presence.
        place: that of a place; before a fit the probability of a place is that of the object.
        window: size of the window of a closer look in a photograph (`semfov.zoom.closer.USUAL_WINDOW`).
        thresholds: thresholds of places after closer looks; None decides searches without them.
        certainty: probability that an object of a photograph is there; None where it was not fitted.
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
        self.place = nn.Linear(1, 1)
        nn.init.ones_(self.place.weight)
        nn.init.zeros_(self.place.bias)
        self.thresholds = thresholds
        self.certainty = certainty

    def presence(self, best: Tensor, target: Tensor) -> Tensor:
        """Predict whether the photograph holds a class.

        Args:
            best: `(...)`, highest score of the class in any hint.
            target: `(...)`, classes 1..K.

        Returns:
            Log odds, `(...)`.
        """
        facts = torch.stack([best.logit(1e-4), self.usual[target - 1]], -1).to(self.whole.weight)
        with without_autocast(facts):
            return self.whole(facts)[..., 0]

    def at_place(self, certainty: Tensor) -> Tensor:
        """Predict whether the target of a search is where an object is.

        Args:
            certainty: `(...)`, probabilities of objects.

        Returns:
            Log odds, `(...)`.
        """
        log_odds = certainty.logit(1e-4)[..., None].to(self.place.weight)
        with without_autocast(log_odds):
            return self.place(log_odds)[..., 0]

    @staticmethod
    def shapes() -> dict[str, tuple[int | str, ...]]:
        """Shapes of the tensors of a fitted one in the file of a model, by name."""
        return {
            "usual": ("K",),
            "whole.weight": (1, 2),
            "whole.bias": (1,),
            "place.weight": (1, 1),
            "place.bias": (1,),
        }


def _fields_of_photographs() -> dict[str, Field]:
    """List the requirements of the tensors of evidence for photographs, which are there where it was fitted."""
    shapes = PhotographEvidence.shapes()
    return {f"photograph.{name}": Field(shape, low=-1e3, high=1e3, optional=True) for name, shape in shapes.items()}


_IN_RECORD = "certainty.", "photograph.certainty."  # parts whose numbers a file has in its record
_CERTAINTY = Maybe(Array(Number(low=-_LARGEST, high=_LARGEST)))
_PHOTOGRAPH = Object(
    {
        "thresholds": THRESHOLDS,
        "certainty": _CERTAINTY,
        "window": Array((Number(above=0, high=1), Number(1, _LARGEST))),
    },
    required=("window",),
)


class GlimpseEvidence(DecidingModule, Pretrained):
    r"""Predicts from a look at a window what looks at its parts find that are one to three octaves closer.

    It answers one question about a part w of the window and a class t, and one about the whole picture. It is fitted on
    mosaics of photographs with annotated boxes.

    - How many objects of t does a closer look at w find that were not found before? The expected number is a sum over
      cells. Its weights fall off towards the border of w, which cuts objects that lie there:

      .. math:: E[n(w)] = \sum_{x \in w} r(x) \lambda(x)

    - Does the picture hold t at all, after the looks of a search? Its odds grow with the expected number N of its
      objects: of those that looks show, each with its probability c (`Certainty`), and of those that closer looks would
      find. They grow with the highest score of t in any look, :math:`s^*`, too, which may be too faint for an object:

      .. math:: N = \sum_i c_i + E[n], \qquad
                \operatorname{logit} P(t) = a \operatorname{logit} s^* + b \ln (N + \varepsilon) + c

    Here λ is a network. Another network predicts how many objects of any class a look finds (`survey`). A closer look
    at a place that seems to hold t is one more look: the place is as probable as the object there.

    Args:
        classes: number of classes of the detector, without background.
        foresight: share of what still closer looks would find in a window that counts towards its value.
        thresholds: thresholds at which searches decide; None where none were chosen.
        places: thresholds of places after closer looks; None decides searches without them.
        certainty: probability that an object is there; None where it was not fitted.
        photograph: evidence for photographs; None where it was not fitted.
        metadata: JSON values kept with the model.

    Raises:
        InputError: a setting is outside its range.

    >>> evidence = GlimpseEvidence(classes=3)
    >>> evidence.presence(torch.rand(5), torch.rand(5)).shape
    torch.Size([5])
    >>> evidence.taper(8).shape
    torch.Size([8])
    """

    kind: ClassVar[str] = "glimpse-evidence"
    title: ClassVar[str] = "model of evidence by magnification"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    schema: ClassVar[Schema] = Schema(
        {
            **perceptron("rate", _RATE, _RATE_WIDTH, STEPS),
            "whole.weight": Field((1, 2), low=-1e3, high=1e3),
            "whole.bias": Field((1,), low=-1e3, high=1e3),
            "prior": Field(("K+1", 2), low=-1e3, high=1e3),
            "border": Field((4,), low=-1e3, high=1e3),
            **{f"survey.{name}": field for name, field in Survey.fields().items()},
            **_fields_of_photographs(),
            "photograph.shares": SHARES,
        },
        {
            "classes": Number(size="K"),
            "foresight": Number(0, 1),
            "thresholds": THRESHOLDS,
            "survey": Object({"foresight": Number(0, 1)}),
            "places": THRESHOLDS,
            "certainty": _CERTAINTY,
            "photograph": Maybe(_PHOTOGRAPH),
        },
    )

    def __init__(
        self,
        classes: int = 80,
        *,
        foresight: float = 0.35,
        thresholds: Thresholds | None = None,
        places: Thresholds | None = None,
        certainty: Certainty | None = None,
        photograph: PhotographEvidence | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        check_whole(classes, "classes", 1, 100_000)
        check_number(foresight, "foresight", 0, 1)
        self.classes = classes
        self.foresight = foresight
        self.thresholds = thresholds
        self.metadata = dict(metadata or {})
        self.rate = network(_RATE, _RATE_WIDTH, STEPS)
        self.whole = nn.Linear(2, 1)
        with torch.no_grad():
            # Until it is fitted, the highest score is the probability.
            self.whole.weight.copy_(torch.tensor([[1.0, 0.0]]))
            self.whole.bias.zero_()
        self.prior = nn.Parameter(torch.zeros(classes + 1, 2))
        self.border = nn.Parameter(torch.tensor([0.0, 1.0, 2.0, 2.0]))
        self.survey = Survey(classes, foresight=foresight)
        self.places = places
        self.certainty = certainty
        self.photograph = photograph

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
        # A compiled or exported graph cannot read the values of a tensor.
        if not torch.compiler.is_compiling():
            classes = targets.tolist()
            check(min(classes) >= 1, "targets", "classes from 1 on", classes)
        columns = targets - 1
        scores = torch.cat([look.best[..., None], look.scores.index_select(-1, columns)], -1)
        every = features(scores.movedim(-1, 0))  # one call for the best of all classes and the targets
        best = every[0]
        hints = every[1:]
        detections = look.found.index_select(-1, columns).movedim(-1, 0).to(hints)
        usual, bias = self.prior.index_select(0, targets).mT[..., None, None]
        crowd = neighbourhood_mean(best[None], CROWD)[0]
        maps = [
            *hint_maps(hints, best, detections, look.size, crowd),
            usual.expand_as(hints),
            *memory_maps(hints, before),
        ]
        value = through(self.rate, torch.stack(maps, -1)) + (bias[..., None] - 6)
        return value.clamp(max=3).movedim(-1, 1)

    def presence(self, best: Tensor, expected: Tensor) -> Tensor:
        """Predict whether the picture holds a class, after the looks of a search.

        Args:
            best: `(...)`, highest score of the class in any look.
            expected: `(...)`, expected number of its objects (`semfov.zoom.places.SearchFacts.expected`).

        Returns:
            Log odds, `(...)`.
        """
        # Scores have the precision of the detector, whatever that of the evidence is.
        facts = self.presence_facts(best, expected).to(self.whole.weight)
        with without_autocast(facts):
            return self.whole(facts)[..., 0]

    @staticmethod
    def presence_facts(best: Tensor, expected: Tensor) -> Tensor:
        """Put together what `presence` is a logistic regression of.

        Args:
            best: `(...)`, as for `presence`.
            expected: `(...)`.

        Returns:
            `(..., 2)`.
        """
        return torch.stack([best.logit(1e-4), (expected + _FEWEST).log()], -1)

    def taper(self, span: int) -> Tensor:
        """Weigh the cells along a side of a window, r; objects at its border are cut.

        Args:
            span: number of cells along the side.

        Returns:
            `(span,)`, from 0 to 1.
        """
        return tapered(self.border, span)

    def certainty_in(self, lattice: Lattice) -> Certainty | None:
        """Choose the certainty of a picture.

        Args:
            lattice: lattice of the picture.

        Returns:
            The probability that an object is there, in a photograph or in a larger picture; None where none was fitted.
        """
        return self.photograph.certainty if self.photograph and lattice.levels == 1 else self.certainty

    def check_compatible(self, settings: Settings) -> None:
        """Raise `InputError` for another detector than the evidence was fitted for.

        Args:
            settings: `WindowEye.settings()`.
        """
        check_same_detector(self.metadata.get("detector", {}), settings["detector"], self.title)

    @property
    def stretch(self) -> bool:
        """Whether windows that reach beyond the picture filled the canvas in the fit (`WindowEye`)."""
        return bool(self.metadata.get("sensor", {}).get("stretch", False))

    def _fitted_values(self) -> dict[str, object]:
        return {**super()._fitted_values(), "places": thresholds_record(self.places)}

    def _load_fitted_values(self, values: Mapping[str, Any]) -> None:
        super()._load_fitted_values(values)
        self.places = thresholds_of(values.get("places"))

    def _tensors(self) -> dict[str, Tensor]:
        return {name: tensor for name, tensor in super()._tensors().items() if not name.startswith(_IN_RECORD)}

    def _record(self) -> dict[str, object]:
        return {
            "classes": self.classes,
            "foresight": self.foresight,
            "thresholds": thresholds_record(self.thresholds),
            "survey": {"foresight": self.survey.foresight},
            "places": thresholds_record(self.places),
            "certainty": _certainty_record(self.certainty),
            "photograph": _photograph_record(self.photograph),
        }

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        photograph = record.get("photograph")
        model = cls(
            classes=record["classes"],
            foresight=record["foresight"],
            metadata=record["metadata"],
            thresholds=thresholds_of(record["thresholds"]),
            places=thresholds_of(record.get("places")),
            photograph=None if photograph is None else _restored_photograph(photograph, record["classes"], tensors),
        )
        model.survey.foresight = record["survey"]["foresight"]
        model.load_state_dict(tensors)
        # Their numbers are in the record, so that they are no part of the state that is loaded.
        model.certainty = _restored_certainty(record)
        if model.photograph is not None:
            model.photograph.certainty = _restored_certainty(record["photograph"])
        return model


# The parts of a model as values of its record, and back.


def _certainty_record(certainty: Certainty | None) -> list[float] | None:
    return None if certainty is None else certainty.numbers


def _photograph_record(photograph: PhotographEvidence | None) -> dict[str, object] | None:
    if photograph is None:
        return None
    return {
        "thresholds": thresholds_record(photograph.thresholds),
        "certainty": _certainty_record(photograph.certainty),
        "window": list(photograph.window),
    }


def _restored_certainty(record: Mapping[str, Any]) -> Certainty | None:
    numbers = record.get("certainty")
    return None if numbers is None else Certainty.of(numbers)


def _restored_photograph(record: Mapping[str, Any], classes: int, tensors: Mapping[str, Tensor]) -> PhotographEvidence:
    least, context = record["window"]
    return PhotographEvidence(
        classes,
        thresholds=thresholds_of(record["thresholds"]),
        window=(least, context),
        shares=tensors.get("photograph.shares"),
    )
