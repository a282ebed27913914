"""The foveal observation model: how a detector scores objects of each class at each distance from the fovea."""

from collections import Counter
from collections.abc import Mapping, Sequence
from copy import deepcopy
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.attribute_words import OBSERVATION_MODEL
from semfov.detection.detector import Detector
from semfov.errors import InputError, check, check_finite, check_shape, check_tensor, lookup, values_known
from semfov.io import compatibility
from semfov.io.files import JsonObject
from semfov.io.pretrained import Pretrained
from semfov.io.schema import CLASSES, Field, Number, Schema
from semfov.observation.dirichlet import floor
from semfov.observation.fitting import fit_tables
from semfov.observation.linear_map import kept_map, linear_map
from semfov.observation.mle import Method
from semfov.observation.presence import PRESENCE, Presence, presence_of
from semfov.observation.statistics import DirichletStatistics
from semfov.observation.thresholds import THRESHOLDS, thresholds_of, thresholds_record
from semfov.precision import without_autocast

_MOST_TEMPERING = 100
_MOST_DISTANCE = 10  # larger ones are taken for pixels: no fixation lies ten longer sides from a box of its image
_MOST_LOG_CELL = 50  # of the logarithms of m, a and w


class FovealObservationModel(Pretrained):
    r"""Dirichlet likelihoods of score vectors, one for each class k and level of distance d to the fovea.

    .. math:: p(S \mid C = k, d) = \mathrm{Dir}(S \mid \alpha_{k,d})

    This is the model of Luzio, Bernardino and Moreno (2024, section III-D), after Dias, Simões, Moreno and Bernardino
    (2022). `calibrate` gives the posterior

    .. math:: P(C = k \mid S, d) \propto \mathrm{Dir}(S \mid \alpha_{k,d})^\tau \, \pi_{k,d}

    With `τ = 1` and a uniform π, the defaults of `fit`, these are the published calibrated scores (equation 11). They
    are overconfident: the density treats its K+1 components as independent evidence, while most scores of a detection
    are near zero together. A class prior and τ < 1 help, and each level may have an exponent that multiplies τ. The
    recommended models use `fit_discriminative`, which trains α and π for the posterior itself; `fit_through_belief`
    learns the odds of a miss from searches. The paper gives neither the number of levels nor their borders, nor its
    treatment of scores of 0: `edges` (`semfov.runs.config.SensorConfig.level_edges`) and `epsilon` are our choice.

    The logit of a class is linear in the log scores, with weights `τ (α - 1)`. The model with `α_k = 1 + e_k`, τ = 1
    and a uniform prior therefore returns the scores unchanged (`identity`).

    Args:
        alpha: `(K+1, N, K+1)`, positive: class (background first), level, component of the score vector.
        edges: N - 1 ascending borders of the levels, in units of the image's longer side. A distance that equals a
            border belongs to the inner level.
        classes: names of the K classes, without background.
        epsilon: lower bound of the scores, from 0 to 1; scores are raised to it and scaled to sum to 1.
        log_prior: `(K+1, N)`, ln π, up to a constant for each level; None is a uniform prior.
        tempering: τ, positive.
        expected: `(K+1, N, K+1)`, the expected scores (`expected_scores`) of models whose Dir(α) does not describe
            the scores, as after `fit_discriminative`; None takes the mean of Dir(α).
        miss_rate: `(K+1, N)`, probability that nothing is detected in a cell of each class (background first) at each
            level of distance (`MissCounts.rates`); None if it is not known.
        exponents: `(N,)`, positive, exponents of the likelihood at each level, in addition to τ; None is 1 at all, as
            published.
        miss_odds: `(K+1, N)`, positive, how probable it is that nothing is detected in a cell of each class, relative
            to background, whose row is ignored (`SemanticSearch`); None takes them from `miss_rate`.
        refutation: ρ, from 0 to 1, share by which a detection loses weight once a cell that it covers was fixated
            (`SemanticSearch`); 0 is as published.
        cell: m, a and w, positive, by which a look says what a whole cell holds (`semfov.observers.SemanticMap`): the
            odds of a miss, an exponent, and the weight of background. The default is about that of YOLOX-nano.
        presence: by which the belief says whether the picture holds a class, with the thresholds at which searches
            decide; None if it was not fitted.
        metadata: JSON values that are saved with the model: `detector` and `sensor` (the settings that it was fitted
            for), `counts`, and further information.

    Attributes:
        log_alpha: `ln α`, a learnable parameter, as are `log_prior` and the following.
        log_exponents: `(N,)`, logarithm of the exponents.
        log_miss: `(K+1, N)`, logarithm of the odds of a miss; None if they are not known.
        refutation: `()`, ρ.
        log_cell: `(3,)`, logarithms of m, a and w.

    Raises:
        InputError: a shape does not fit, or a value is out of range.

    >>> model = FovealObservationModel.identity(["cup", "cat"], edges=[0.1, 0.2])
    >>> model.calibrate(torch.tensor([0.2, 0.7, 0.1]), torch.tensor(0.15)).detach()
    tensor([0.2000, 0.7000, 0.1000])
    """

    kind: ClassVar[str] = "foveal-observation-model"
    title: ClassVar[str] = "observation model"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    other_words: ClassVar[Mapping[str, str]] = OBSERVATION_MODEL
    schema: ClassVar[Schema] = Schema(
        {
            "log_alpha": Field(("K+1", "N", "K+1"), low=-30, high=30),
            "edges": Field(("N-1",), above=0, high=100, ascending=True),
            "log_prior": Field(("K+1", "N"), low=-1e4, high=1e4),
            "tempering": Field((), above=0, high=_MOST_TEMPERING),
            "expected": Field(("K+1", "N", "K+1"), low=0, high=1, simplex=True, optional=True),
            "miss_rate": Field(("K+1", "N"), low=0, high=1, optional=True),
            "log_exponents": Field(("N",), low=-10, high=10, optional=True),
            "log_miss": Field(("K+1", "N"), low=-50, high=50, optional=True),
            "refutation": Field((), low=0, high=1, optional=True),
            "log_cell": Field((3,), low=-_MOST_LOG_CELL, high=_MOST_LOG_CELL, optional=True),
            **PRESENCE,
        },
        {"classes": CLASSES, "epsilon": Number(above=0, high=1), "thresholds": THRESHOLDS},
    )
    edges: Tensor
    tempering: Tensor
    expected: Tensor | None
    miss_rate: Tensor | None

    def __init__(
        self,
        alpha: Tensor,
        edges: Sequence[float] | Tensor,
        classes: Sequence[str],
        *,
        epsilon: float = 1e-6,
        log_prior: Tensor | None = None,
        tempering: float = 1.0,
        expected: Tensor | None = None,
        miss_rate: Tensor | None = None,
        exponents: Tensor | None = None,
        miss_odds: Tensor | None = None,
        refutation: float | Tensor = 0.0,
        cell: Sequence[float] | Tensor = (0.001, 1.0, 0.25),
        presence: Presence | None = None,
        metadata: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__()
        check_tensor(alpha, "alpha")
        check(not isinstance(classes, str), "classes", "a sequence of names", repr(classes))
        repeated = [name for name, count in Counter(classes).items() if count > 1]
        check(not repeated, "classes", "names that are all different", f"{repeated} more than once")
        components = len(classes) + 1
        borders = _checked_borders(edges, alpha)
        levels = len(borders) + 1
        shape = (components, levels, components)
        check(tuple(alpha.shape) == shape, "alpha", f"shape (K+1, N, K+1) = {shape}", tuple(alpha.shape))
        check_finite(alpha, "alpha")
        check(bool((alpha > 0).all()), "alpha", "positive numbers", float(alpha.detach().min()))
        check(0 < epsilon < 1, "epsilon", "a number between 0 and 1", epsilon)
        check(0 < tempering <= _MOST_TEMPERING, "tempering", f"a number above 0, up to {_MOST_TEMPERING}", tempering)
        self.classes = tuple(classes)
        self.epsilon = epsilon
        self.metadata = dict(metadata or {})

        by_class_and_level = (components, levels)
        priors = _table(log_prior, "log_prior", by_class_and_level, alpha)
        if priors is None:
            priors = alpha.new_zeros(by_class_and_level)
        rates = _table(miss_rate, "miss_rate", by_class_and_level, alpha)
        if rates is not None:
            are_probabilities = bool(((rates >= 0) & (rates <= 1)).all())
            check(are_probabilities, "miss_rate", "probabilities", "numbers outside [0, 1]")
        odds = _positive_table(miss_odds, "miss_odds", by_class_and_level, alpha)
        powers = _positive_table(exponents, "exponents", (levels,), alpha)
        if powers is None:
            powers = alpha.new_ones(levels)
        rho = torch.as_tensor(refutation).detach().to(alpha).clone()
        check(0 <= float(rho) <= 1, "refutation", "a number from 0 to 1", refutation)

        self.log_alpha = nn.Parameter(alpha.detach().log())
        self.register_buffer("edges", borders)
        self.register_buffer("expected", _table(expected, "expected", shape, alpha))
        self.register_buffer("miss_rate", rates)
        self.register_buffer("tempering", alpha.new_tensor(tempering))
        self.log_prior = nn.Parameter(priors)
        self.log_exponents = nn.Parameter(powers.log())
        self.log_miss = None if odds is None else nn.Parameter(odds.log())
        self.refutation = nn.Parameter(rho)
        self.log_cell = nn.Parameter(_checked_log_cell(cell, alpha))
        if presence is not None:
            check(isinstance(presence, Presence), "presence", "a Presence or None", type(presence).__name__)
            known = len(presence.shares)
            check(known == len(classes), "presence", f"one of {len(classes)} classes", f"one of {known}")
        self.presence = None if presence is None else deepcopy(presence)

    @classmethod
    def identity(cls, classes: Sequence[str], edges: Sequence[float] | Tensor, **settings: Any) -> Self:
        """Make the model with `α_k = 1 + e_k`, whose `calibrate` returns the scores unchanged.

        Args:
            classes: names of the K classes, without background.
            edges: N - 1 ascending borders of the levels, in units of the image's longer side.
            settings: further arguments of the class.

        Returns:
            The model.
        """
        levels = len(edges) + 1
        unit = torch.eye(len(classes) + 1)
        alpha = 1 + unit[:, None].repeat(1, levels, 1)
        return cls(alpha, edges, classes, **settings)

    @property
    def alpha(self) -> Tensor:
        """Dirichlet parameters, `(K+1, N, K+1)`, positive by construction; differentiable in `log_alpha`."""
        return self.log_alpha.exp()

    def level(self, distance: Tensor) -> Tensor:
        """Find the level of each distance.

        Args:
            distance: `(...)`, in units of the image's longer side, 0 or more.

        Returns:
            `(...)` int64, from 0 (the fovea) to N - 1.

        Raises:
            InputError: a distance is negative, NaN, or so large that it must be in pixels.
        """
        if distance.numel() and values_known(distance):
            least, largest = torch.stack(distance.detach().aminmax()).tolist()
            check(least >= 0, "distance", "numbers from 0 up", "NaN or a negative number")
            near = largest < _MOST_DISTANCE or largest == float("inf")
            got = f"{largest:g}; divide distances in pixels by it"
            check(near, "distance", "units of the image's longer side", got)
        return self._level(distance)

    def _level(self, distance: Tensor) -> Tensor:
        """Find the level without checks, which wait for a GPU."""
        return torch.bucketize(distance.to(self.edges).contiguous(), self.edges)

    def log_likelihood(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Compute the log likelihood of every class k, `ln Dir(S | α_{k,d})`.

        It is the logarithm of equation 9 of Luzio, Bernardino and Moreno (2024).

        Args:
            scores: `(..., K+1)`, points of the simplex; raised to at least `epsilon`.
            distance: `(...)`, from the fixation to the centre of the box, in units of the image's longer side.

        Returns:
            `(..., K+1)`, in the dtype of the scores.

        Raises:
            InputError: shapes do not fit, or a score is negative or not finite.
        """
        check_tensor(scores, "scores")
        return self._log_likelihood(scores, distance).to(scores.dtype)

    def _log_likelihood(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Compute the log likelihoods in the precision of the scores, or of the parameters where that is higher.

        They are large numbers, and half precision would round them to whole nats.
        """
        components = len(self.classes) + 1
        check_tensor(distance, "distance")
        check(scores.is_floating_point(), "scores", "a floating-point tensor", scores.dtype)
        check_shape(scores, "scores", components)
        shape = tuple(scores.shape[:-1])
        check(shape == distance.shape, "distance", f"shape {shape}", tuple(distance.shape))
        weight, constant = self._linear()
        precision = torch.promote_types(scores.dtype, weight.dtype)
        log_scores = floor(scores.to(precision), self.epsilon).log().to(weight.dtype)
        # One product for all levels and a selection cost less than gathering a matrix for each detection.
        with without_autocast(weight):
            by_level = F.linear(log_scores, weight, constant).unflatten(-1, (-1, components))
        level = self.level(distance)
        index = level[..., None, None].expand(*level.shape, 1, components)
        return by_level.gather(-2, index).squeeze(-2).to(precision)

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Calibrate scores: compute the posterior probability of every class.

        With a uniform prior and τ = 1 they are proportional to the likelihoods, and fusion needs no more. They are
        differentiable in the scores and the parameters. The distance chooses a level, so no gradient flows through it.

        Args:
            scores: `(..., K+1)`, points of the simplex; raised to at least `epsilon`.
            distance: `(...)`, from the fixation to the centre of the box, in units of the image's longer side.

        Returns:
            `(..., K+1)`, which sums to 1, in the dtype of the scores.

        Raises:
            InputError: shapes do not fit, or a score is negative or not finite.
        """
        check_tensor(scores, "scores")
        likelihood = self._log_likelihood(scores, distance)
        level = self._level(distance)
        # An embedding, since indices of tensors are no part of `torch.func`.
        exponents = F.embedding(level, self.log_exponents.exp()[:, None]).to(likelihood)
        logits = likelihood * self.tempering * exponents
        return (logits + F.embedding(level, self.log_prior.t())).softmax(-1).to(scores.dtype)

    def expected_scores(self) -> Tensor:
        """Compute the expected score vector of every class at every level, `E[S | C = k, d]`.

        In the published model it is the mean of the Dirichlet, `α_kd / Σ_j α_kdj`, the first factor in equation 16 of
        Luzio, Bernardino and Moreno (2024).

        Returns:
            `(K+1, N, K+1)`: class, level, component.
        """
        return self.log_alpha.softmax(-1) if self.expected is None else self.expected

    def miss_likelihood(self, distance: Tensor) -> Tensor:
        """Compute the likelihood of every class where nothing is detected: its miss rate at that distance.

        Args:
            distance: `(...)`, in units of the image's longer side.

        Returns:
            `(..., K+1)`, background first.

        Raises:
            InputError: the model has no `miss_rate`.
        """
        if self.miss_rate is None:
            raise InputError("miss_rate: expected a model fitted with miss rates (`train.fit_fom`), got one without")
        return F.embedding(self.level(distance), self.miss_rate.t())

    def miss_odds(self, distance: Tensor) -> Tensor:
        """Compute the odds of a miss: how probable it is that nothing is detected, relative to background.

        Args:
            distance: `(...)`, in units of the image's longer side.

        Returns:
            `(..., K+1)`, 1 for background; differentiable in `log_miss`. A model without learned odds takes the ratio
            of its miss rates.

        Raises:
            InputError: the model has neither odds of a miss nor miss rates.

        >>> rates = torch.tensor([[0.8], [0.2]])  # of background and of the cup
        >>> FovealObservationModel.identity(["cup"], [], miss_rate=rates).miss_odds(torch.zeros(1))
        tensor([[1.0000, 0.2500]])
        """
        if self.log_miss is None:
            rates = self.miss_likelihood(distance)
            return rates / rates[..., :1]
        odds = torch.cat([torch.ones_like(self.log_miss[:1]), self.log_miss[1:].exp()])
        return F.embedding(self.level(distance), odds.t())

    forward = calibrate

    @torch.no_grad()
    def fit(
        self,
        statistics: DirichletStatistics,
        *,
        method: Method = "newton",
        shrinkage: float = 10.0,
        minimum: int = 100,
        enough: int | None = None,
        prior: bool = False,
        tempering: float = 1.0,
        expected: Literal["dirichlet", "empirical"] = "dirichlet",
        **metadata: object,
    ) -> Self:
        """Set α to its maximum a posteriori estimate, given the statistics of a training set.

        `semfov.observation.fitting.fit_tables` explains the estimate and how it differs from that of the paper. A level
        with fewer than `minimum` objects is fitted with the samples of its neighbours; a warning reports it, and
        `metadata["pooled"]` records it.

        Args:
            statistics: sums of the scores by class and level, of shape `(K+1, N)`.
            method: `newton`, `fixed_point` or `gradient` (`semfov.dirichlet.mle`).
            shrinkage: pseudo-counts that draw each table cell towards its class.
            minimum: least number of objects in a level, background not counted.
            enough: a cell with at least this many detections is fitted by maximum likelihood alone; None shrinks all
                cells.
            prior: use the class frequencies as prior; False uses a uniform prior, as published.
            tempering: exponent τ of the likelihood.
            expected: source of `expected_scores`: `dirichlet`, the means of the fitted Dirichlets, as published, or
                `empirical`, the means of the data. They differ, because a Dirichlet fitted to mean log scores need
                not have the mean of the scores.
            metadata: JSON values to save with the model.

        Returns:
            This model.

        Raises:
            InputError: the statistics are for another table or epsilon, or a setting is out of range.
        """
        components, levels = self.log_alpha.shape[:2]
        required = ((components, levels), self.epsilon)
        got = (statistics.shape, statistics.epsilon)
        check(got == required, "statistics", f"shape and epsilon {required}", got)
        check(0 < tempering <= _MOST_TEMPERING, "tempering", f"a number above 0, up to {_MOST_TEMPERING}", tempering)
        lookup(expected, ["dirichlet", "empirical"], "kind of expected scores")
        alpha, log_prior, mean, record = fit_tables(
            statistics, method=method, shrinkage=shrinkage, minimum=minimum, enough=enough
        )
        self.log_alpha.copy_(alpha.log())
        self.log_prior.copy_(log_prior if prior else torch.tensor(0.0))
        self.tempering.fill_(tempering)
        self.expected = mean.to(self.log_alpha) if expected == "empirical" else None
        self.metadata |= {**record, "expected": expected, **metadata}
        return self

    @property
    def true_cells(self) -> bool:
        """Whether searches use calibrated probabilities of cells (`Presence.of_cells`)."""
        return self.presence is not None and self.presence.centre is not None

    def check_compatible(
        self,
        settings: compatibility.Settings | None = None,
        classes: Sequence[str] | None = None,
        background: str | None = None,
    ) -> None:
        """Check that the model was fitted for a detector or an eye.

        Weights, classes and background policy must equal those of the fit, as far as `metadata` records them. Other
        settings that differ give a warning.

        Args:
            settings: `Detector.settings()`, or `Eye.settings()`: `{"detector": ..., "sensor": ...}`.
            classes: names of the K classes; None does not check them.
            background: background policy of the scores; None does not check it.

        Raises:
            InputError: the weights, the classes or the background policy differ.
        """
        settings = settings or {}
        eye = settings if "detector" in settings else {"detector": settings}
        fitted = self.metadata.get("detector", {})
        compatibility.check_classes(self.classes, classes, self.title)
        compatibility.check_background(fitted, background, self.title)
        compatibility.check_same_detector(fitted, eye["detector"], self.title)
        compatibility.check_sensor(self.metadata.get("sensor", {}), eye.get("sensor", {}), self.title)

    def _record(self) -> dict[str, object]:
        """List what a file holds beside tensors."""
        record: dict[str, object] = {"classes": self.classes, "epsilon": self.epsilon}
        if self.presence is not None:
            record["thresholds"] = thresholds_record(self.presence.thresholds)
        return record

    @classmethod
    def _restore(cls, record: JsonObject, tensors: dict[str, Tensor]) -> Self:
        """Make the model of a file."""
        model = cls(
            tensors["log_alpha"].exp(),
            tensors["edges"],
            record["classes"],
            epsilon=record["epsilon"],
            expected=tensors.get("expected"),
            miss_rate=tensors.get("miss_rate"),
            miss_odds=tensors["log_miss"].exp() if "log_miss" in tensors else None,
            presence=presence_of(tensors, thresholds_of(record.get("thresholds"))),
            metadata=record["metadata"],
        )
        # Parameters that a file leaves out have the paper's values.
        model.load_state_dict({**model.state_dict(), **tensors})
        return model

    @classmethod
    def from_pretrained(cls, name_or_path: str | PathLike[str], *, detector: Detector | None = None) -> Self:
        """Load a model: one shipped with the package, by its name, or a file that `save` wrote, by its path.

        Args:
            name_or_path: name of a shipped model, or path of a `.safetensors` file.
            detector: the `semfov.Detector` that the model will be used with; checked by `check_compatible`.

        Returns:
            The model, in `eval` mode.

        Raises:
            InputError: no model of that name is shipped, or it was not fitted for `detector`.
            DataError: the file is missing or damaged, or holds no observation model.
        """
        model = super().from_pretrained(name_or_path)
        if detector is not None:
            model.check_compatible(detector.settings(), detector.classes)
        return model

    def extra_repr(self) -> str:
        """Return the sizes for `repr`.

        Returns:
            Numbers of classes and levels, and ε.
        """
        return f"classes={len(self.classes)}, levels={len(self.edges) + 1}, epsilon={self.epsilon}"

    def _linear(self) -> tuple[Tensor, Tensor]:
        """Compute weights and constants of the log likelihoods (`linear_map`).

        They are kept in `eval` mode and without gradients, on the CPU: a GPU would be waited for to compare parameters.
        """
        parameter = self.log_alpha
        is_recorded = torch.is_grad_enabled() and parameter.requires_grad
        is_here = parameter.device.type == "cpu"
        if self.training or is_recorded or torch.compiler.is_exporting() or not is_here:
            return linear_map(self.alpha)
        if torch.compiler.is_compiling():
            # A graph would compute the gamma functions at each call, so that it takes ten times as long.
            weight, constant = torch.ops.semfov.linear_map(parameter)
            return weight, constant
        # Values that are not known cannot be compared: those of a model in `torch.func`.
        return kept_map(parameter) if values_known(parameter) else linear_map(self.alpha)


def _checked_borders(edges: Sequence[float] | Tensor, like: Tensor) -> Tensor:
    """Check the borders of the levels of distance, and copy them, `(N - 1,)`."""
    borders = torch.as_tensor(edges, dtype=like.dtype, device=like.device).reshape(-1).clone()
    check_finite(borders, "edges")
    are_ascending = bool((borders.diff() > 0).all()) and bool((borders > 0).all())
    check(are_ascending, "edges", "positive, ascending numbers", borders.tolist())
    return borders


def _checked_log_cell(cell: Sequence[float] | Tensor, like: Tensor) -> Tensor:
    """Check m, a and w, and return their logarithms, `(3,)`."""
    are_numbers = isinstance(cell, Tensor) or (
        isinstance(cell, Sequence) and all(isinstance(number, int | float) for number in cell)
    )
    check(are_numbers, "cell", "three positive numbers", repr(cell))
    numbers = torch.as_tensor(cell).detach().to(like)
    check(tuple(numbers.shape) == (3,), "cell", "shape (3,)", tuple(numbers.shape))
    logarithms = numbers.log()
    is_inside = bool((logarithms.abs() <= _MOST_LOG_CELL).all())  # not so for NaN
    check(is_inside, "cell", f"numbers from e^-{_MOST_LOG_CELL} to e^{_MOST_LOG_CELL}", numbers.tolist())
    return logarithms


def _table(table: Tensor | None, name: str, shape: tuple[int, ...], like: Tensor) -> Tensor | None:
    """Check a table that may be left out, and copy it."""
    if table is None:
        return None
    check(tuple(table.shape) == shape, name, f"shape {shape}", tuple(table.shape))
    check_finite(table, name)
    return table.detach().to(like).clone()


def _positive_table(table: Tensor | None, name: str, shape: tuple[int, ...], like: Tensor) -> Tensor | None:
    """Check a table of positive numbers that may be left out, and copy it."""
    copied = _table(table, name, shape, like)
    if copied is not None:
        check(bool((copied > 0).all()), name, "positive numbers", float(copied.min()))
    return copied
