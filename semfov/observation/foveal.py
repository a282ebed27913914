"""The foveal observation model: how a detector scores objects of each class at each distance from the fovea."""

import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection.detector import Detector
from semfov.errors import InputError, check, check_finite, check_shape, lookup, values_known
from semfov.io import compatibility
from semfov.io.pretrained import Pretrained
from semfov.io.schema import CLASSES, Field, Number, Schema
from semfov.observation.dirichlet import floor, log_normaliser
from semfov.observation.fitting import estimate_prior, expected_table, fit_table
from semfov.observation.mle import Method
from semfov.observation.statistics import DirichletStatistics

_MOST_TEMPERING = 100


class FovealObservationModel(Pretrained):
    r"""Dirichlet likelihoods of score vectors, one for each class k and level of distance d to the fovea.

    .. math:: p(S \mid C = k, d) = \mathrm{Dir}(S \mid \alpha_{k,d})

    (Luzio, Bernardino and Moreno, 2024, section III-D, after Dias, Simões, Moreno and Bernardino, 2022.) The posterior
    that `calibrate` gives is

    .. math:: P(C = k \mid S, d) \propto \mathrm{Dir}(S \mid \alpha_{k,d})^\tau \, \pi_{k,d}

    With `τ = 1` and a uniform π, as `fit` leaves them, these are the published calibrated scores (equation 11). They
    are overconfident: the density multiplies K+1 dimensions as if each were evidence of its own, though most scores
    are near zero together. A class prior and τ < 1 help; `semfov.observation.fit_discriminative` trains α and π for
    the posterior itself, and is what the recommended models use. The paper prints neither the number of levels nor
    their borders, nor what is done with scores of 0: `edges` and `epsilon` are our choice.

    The logit of a class is linear in the log scores, with weights `τ (α - 1)`. So `α_k = 1 + e_k` with all else
    uniform (`identity`) gives back the scores as they are.

    Args:
        alpha: `(K+1, N, K+1)`, positive: class (background first), level, component of the score vector.
        edges: N - 1 ascending borders of the levels, in units of the image's longer side. A distance that equals a
            border belongs to the inner level.
        classes: names of the K classes, without background.
        epsilon: scores are raised to at least this, and scaled to sum to 1.
        log_prior: `(K+1, N)`, ln π up to a constant for each level; None is uniform.
        tempering: τ, positive.
        expected: `(K+1, N, K+1)`, what `expected_scores` returns where that is not the mean of Dir(α), as in models
            trained for the posterior; None takes the mean.
        miss_rate: `(K+1, N)`, probability that nothing is detected where there is an object of a class (background
            first) at a level of distance (`MissCounts.rates`); None where it is not known.
        metadata: JSON values that are kept with the model: `detector` and `sensor` (settings it was fitted for),
            `counts`, and whatever else is worth knowing.

    Attributes:
        log_alpha: the learnable parameter, `ln α`.

    >>> model = FovealObservationModel.identity(["cup", "cat"], edges=[0.1, 0.2])
    >>> model.calibrate(torch.tensor([0.2, 0.7, 0.1]), torch.tensor(0.15)).detach()
    tensor([0.2000, 0.7000, 0.1000])
    """

    kind: ClassVar[str] = "foveal-observation-model"
    title: ClassVar[str] = "observation model"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    schema: ClassVar[Schema] = Schema(
        {
            "log_alpha": Field(("K+1", "N", "K+1"), low=-30, high=30),
            "edges": Field(("N-1",), above=0, high=100, ascending=True),
            "log_prior": Field(("K+1", "N"), low=-1e4, high=1e4),
            "tempering": Field((), above=0, high=_MOST_TEMPERING),
            "expected": Field(("K+1", "N", "K+1"), low=0, high=1, simplex=True, optional=True),
            "miss_rate": Field(("K+1", "N"), low=0, high=1, optional=True),
        },
        {"classes": CLASSES, "epsilon": Number(above=0, high=1)},
    )
    edges: Tensor
    log_prior: Tensor
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
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        components = len(classes) + 1
        borders = torch.as_tensor(edges, dtype=alpha.dtype, device=alpha.device).reshape(-1).clone()
        check_finite(borders, "edges")
        ascending = bool((borders.diff() > 0).all()) and bool((borders > 0).all())
        check(ascending, "edges", "positive, ascending numbers", borders.tolist())
        shape = (components, len(borders) + 1, components)
        check(tuple(alpha.shape) == shape, "alpha", f"shape (K+1, N, K+1) = {shape}", tuple(alpha.shape))
        check_finite(alpha, "alpha")
        check(bool((alpha > 0).all()), "alpha", "positive numbers", float(alpha.detach().min()))
        check(0 < epsilon < 1, "epsilon", "a number between 0 and 1", epsilon)
        check(0 < tempering <= _MOST_TEMPERING, "tempering", f"a number above 0, up to {_MOST_TEMPERING}", tempering)
        self.classes = tuple(classes)
        self.epsilon = epsilon
        self.metadata = dict(metadata or {})
        self.log_alpha = nn.Parameter(alpha.detach().log())
        self.register_buffer("edges", borders)
        for name, table, size in [
            ("log_prior", log_prior, shape[:2]),
            ("expected", expected, shape),
            ("miss_rate", miss_rate, shape[:2]),
        ]:
            if table is not None:
                check(tuple(table.shape) == size, name, f"shape {size}", tuple(table.shape))
                check_finite(table, name)
                unlikely = name == "miss_rate" and not bool(((table >= 0) & (table <= 1)).all())
                check(not unlikely, name, "probabilities", "numbers outside [0, 1]")
                table = table.detach().to(alpha).clone()
            elif name == "log_prior":
                table = alpha.new_zeros(size)
            self.register_buffer(name, table)
        self.register_buffer("tempering", alpha.new_tensor(tempering))
        self._cache: tuple[Tensor, int, int, Tensor, Tensor] | None = None

    @classmethod
    def identity(cls, classes: Sequence[str], edges: Sequence[float] | Tensor, **settings: Any) -> Self:
        """The model that calibrates nothing: `α_k = 1 + e_k`, so that `calibrate` returns the scores."""
        levels = len(edges) + 1
        alpha = 1 + torch.eye(len(classes) + 1)[:, None].repeat(1, levels, 1)
        return cls(alpha, edges, classes, **settings)

    @property
    def alpha(self) -> Tensor:
        """Dirichlet parameters, `(K+1, N, K+1)`, positive by construction; differentiable in `log_alpha`."""
        return self.log_alpha.exp()

    def level(self, distance: Tensor) -> Tensor:
        """Level of each distance, `(...)` from 0 (the fovea) to N - 1."""
        if distance.numel() and values_known(distance):
            check(bool((distance >= 0).all()), "distance", "numbers from 0 up", "NaN or a negative number")
        return torch.bucketize(distance.to(self.edges).contiguous(), self.edges)

    def log_likelihood(self, scores: Tensor, distance: Tensor) -> Tensor:
        """`ln Dir(S | α_{k,d})` for every class k, `(..., K+1)` (Luzio, Bernardino and Moreno, 2024, equation 9).

        Args:
            scores: `(..., K+1)`, points of the simplex; floored at `epsilon`.
            distance: `(...)`, from the fixation to the centre of the box, in units of the image's longer side.

        Raises:
            InputError: shapes do not fit, or a score is negative or not finite.
        """
        components = len(self.classes) + 1
        check_shape(scores, "scores", components)
        check(
            scores.shape[:-1] == distance.shape, "distance", f"shape {tuple(scores.shape[:-1])}", tuple(distance.shape)
        )
        weight, constant = self._linear()
        log_scores = floor(scores, self.epsilon).log().to(weight.dtype)
        # One product for all levels, and a pick, costs less than fetching a matrix for each detection.
        every = F.linear(log_scores, weight, constant).unflatten(-1, (-1, components))
        index = self.level(distance)[..., None, None].expand(*distance.shape, 1, components)
        return every.gather(-2, index).squeeze(-2).to(scores.dtype)

    def calibrate(self, scores: Tensor, distance: Tensor) -> Tensor:
        """Calibrated scores, the posterior of the classes, `(..., K+1)`; arguments and errors as `log_likelihood`.

        With a uniform prior they are proportional to the likelihoods, which is all that fusion needs.
        """
        logits = self.log_likelihood(scores, distance) * self.tempering
        return (logits + F.embedding(self.level(distance), self.log_prior.t())).softmax(-1).to(scores.dtype)

    def expected_scores(self) -> Tensor:
        """Scores to expect of an object, `E[S | C = k, d]`, `(K+1, N, K+1)`.

        Published is the mean of the Dirichlet, `α_kd / Σ_j α_kdj` (Luzio, Bernardino and Moreno, 2024, equation 16).
        """
        return self.log_alpha.softmax(-1) if self.expected is None else self.expected

    def miss_likelihood(self, distance: Tensor) -> Tensor:
        """Likelihood of seeing nothing at a distance `(...)` for what may be there, `(..., K+1)`.

        Raises:
            InputError: the model has no `miss_rate`.
        """
        if self.miss_rate is None:
            raise InputError("miss_rate: expected a model that was fitted with miss rates, got none")
        return F.embedding(self.level(distance), self.miss_rate.t())

    def forward(self, scores: Tensor, distance: Tensor) -> Tensor:
        """As `calibrate`."""
        return self.calibrate(scores, distance)

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
        **metadata: Any,
    ) -> Self:
        """Set α to the maximum a posteriori under the statistics of a training set, and return the model itself.

        See `semfov.observation.fitting.fit_table` for the estimate, and for how it differs from the paper's. A level
        with fewer than `minimum` objects takes the parameters of its inner neighbour; a warning and
        `metadata["fallback"]` say so.

        Args:
            statistics: sums of the scores by class and level, of shape `(K+1, N)`.
            method: `newton`, `fixed_point` or `gradient` (`semfov.dirichlet.mle`).
            shrinkage: pseudo-counts that draw a cell to its class.
            minimum: objects, background not counted, that a level needs.
            enough: detections from which a cell is fitted by maximum likelihood alone; None shrinks all cells.
            prior: take the frequencies of the classes as prior; False leaves it uniform, as published.
            tempering: exponent τ of the likelihood.
            expected: what `expected_scores` returns: the means of the fitted Dirichlets, as published, or those of
                the data. They differ, for a Dirichlet that is fitted to mean logs need not have the mean of the data.
            metadata: JSON values to keep with the model.
        """
        components, levels = self.log_alpha.shape[:2]
        wanted, got = ((components, levels), self.epsilon), (statistics.shape, statistics.epsilon)
        check(got == wanted, "statistics", f"shape and epsilon {wanted}", got)
        check(0 < tempering <= _MOST_TEMPERING, "tempering", f"a number above 0, up to {_MOST_TEMPERING}", tempering)
        lookup(expected, ["dirichlet", "empirical"], "kind of expected scores")
        alpha, fallback = fit_table(statistics, method=method, shrinkage=shrinkage, minimum=minimum, enough=enough)
        if fallback:
            told = ", ".join(f"level {n} as level {source}" for n, source in fallback.items() if n > 0)
            told += "; level 0 has no inner neighbour and rests on the classes' other levels" * (0 in fallback)
            warnings.warn(f"levels with fewer than {minimum} objects fall back: {told}", stacklevel=2)
        self.log_alpha.copy_(alpha.log())
        self.log_prior.copy_(estimate_prior(statistics.count, shrinkage) if prior else torch.tensor(0.0))
        self.tempering.fill_(tempering)
        own = expected == "empirical"
        self.expected = expected_table(statistics, fallback, shrinkage).to(self.log_alpha) if own else None
        self.metadata |= {
            "counts": statistics.count.tolist(),
            "fallback": {str(level): source for level, source in fallback.items()},
            "method": method,
            "shrinkage": shrinkage,
            "minimum": minimum,
            "enough": enough,
            "expected": expected,
            **metadata,
        }
        return self

    def check_compatible(
        self,
        settings: Mapping[str, Any] | None = None,
        classes: Sequence[str] | None = None,
        background: str | None = None,
    ) -> None:
        """Raise `InputError` where the model is to be used beside something that it was not fitted for.

        Weights, classes and background policy must be those of the fit, as far as `metadata` tells them; other
        settings that differ are warned of.

        Args:
            settings: `Detector.settings()`, or an eye's: `{"detector": ..., "sensor": ...}`.
            classes: names of the K classes.
            background: background policy of the scores.
        """
        settings = settings or {}
        eye = settings if "detector" in settings else {"detector": settings}
        fitted = self.metadata.get("detector", {})
        compatibility.check_classes(self.classes, classes, self.title)
        compatibility.check_background(fitted, background, self.title)
        compatibility.check_detector(fitted, eye["detector"], self.title)
        compatibility.check_sensor(self.metadata.get("sensor", {}), eye.get("sensor", {}), self.title)

    def _record(self) -> dict[str, Any]:
        """Classes and ε."""
        return {"classes": self.classes, "epsilon": self.epsilon}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The model from what was kept."""
        model = cls(
            tensors["log_alpha"].exp(),
            tensors["edges"],
            record["classes"],
            epsilon=record["epsilon"],
            expected=tensors.get("expected"),
            miss_rate=tensors.get("miss_rate"),
            metadata=record["metadata"],
        )
        model.load_state_dict(tensors)
        return model

    @classmethod
    def from_pretrained(cls, name_or_path: str | PathLike[str], *, detector: Detector | None = None) -> Self:
        """A model that is shipped with the package, by name, or one that `save` wrote, by path; in `eval` mode.

        Args:
            name_or_path: name, or path of a `.safetensors` file.
            detector: a `semfov.Detector` that the model will be used with; checked by `check_compatible`.

        Raises:
            InputError: no model of that name is shipped, or it was not fitted for `detector`.
            DataError: the file is missing, damaged or not a model.
        """
        model = super().from_pretrained(name_or_path)
        if detector is not None:
            model.check_compatible(detector.settings(), detector.classes)
        return model

    def train(self, mode: bool = True) -> Self:
        """As for every module; also forgets what `eval` mode keeps between calls."""
        self._cache = None
        return super().train(mode)

    def extra_repr(self) -> str:
        """Sizes, for `repr`."""
        return f"classes={len(self.classes)}, levels={len(self.edges) + 1}, epsilon={self.epsilon}"

    def _linear(self) -> tuple[Tensor, Tensor]:
        """Weights `(N (K+1), K+1)` and constants of the log likelihoods, level by level.

        Without gradients and in `eval` mode they are kept until `log_alpha` changes.
        """
        parameter = self.log_alpha
        learning = self.training or (torch.is_grad_enabled() and parameter.requires_grad)
        if learning or torch.compiler.is_compiling() or parameter.is_inference():
            return self._make_linear()
        key = (parameter, parameter._version, parameter.data_ptr())
        if self._cache is None or self._cache[0] is not parameter or self._cache[1:3] != key[1:]:
            with torch.inference_mode(False), torch.no_grad():
                self._cache = (*key, *self._make_linear())
        return self._cache[3:]

    def _make_linear(self) -> tuple[Tensor, Tensor]:
        alpha = self.alpha.transpose(0, 1)
        # ln Γ of large parameters needs the digits: likelihoods differ by less than it is large.
        constant = -log_normaliser(alpha.to(torch.float64)).to(alpha.dtype)
        return (alpha - 1).flatten(0, 1), constant.flatten()
