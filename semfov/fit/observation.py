"""Fit a foveal observation model to labelled detections."""

import warnings
from typing import Any, Protocol

from semfov.data.scene import Scenes
from semfov.errors import DataError, check
from semfov.eye import Eye
from semfov.fit.misses import count_misses
from semfov.fit.observation_report import write_report
from semfov.fit.observation_settings import FitObservationConfig
from semfov.fit.outputs import model_path
from semfov.observation import fit_discriminative
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.mle import Method
from semfov.observation.statistics import DirichletStatistics
from semfov.runs.samples import Samples, SampleSettings, collect_samples
from semfov.runs.workers import rank
from semfov.runs.zoom_samples import MosaicSettings
from semfov.zoom.eye import WindowEye


def fit_fom(config: FitObservationConfig) -> None:
    """Collect labelled detections, fit the model, evaluate it on held-out photographs, and write all results."""
    check(config.holdout >= 2, "holdout", "2 or more", config.holdout)
    kind = MosaicSettings if config.mosaics else SampleSettings
    settings = kind.of(config)
    sampler, samples = collect_samples(settings, (config.cache or config.out) / "samples", config.workers, "looking")
    if rank() > 0:
        return
    held_out = samples.scene % config.holdout == 0
    if not held_out.any() or held_out.all():
        raise DataError(
            f"data: expected detections both in the training and in the held-out photographs, got {len(samples)} "
            "detections in all; give more photographs"
        )
    model = fit_model(config, sampler, samples[~held_out])
    fitted_on = {index for index in range(len(sampler.scenes)) if index % config.holdout != 0}
    misses = count_misses(sampler.scenes, samples, fitted_on, model.edges, sampler.cells)
    model.miss_rate = misses.rates().to(model.edges)
    if config.mosaics:
        model.metadata["cells"] = misses.total.sum(1).tolist()
    path = model_path(config, sampler.eye.detector.name)
    model.save(path)
    written = write_report(config, model, fit_all(config, sampler, samples[~held_out], model), samples, held_out)
    print("written:")
    for file in [path, *written]:
        print(f"  {file}")


class Looker(Protocol):
    """The source of the detections: a `Sampler`, or a run with looks from every cell."""

    @property
    def eye(self) -> Eye | WindowEye:
        """The eye that looked."""
        ...

    scenes: Scenes


def fit_model(config: FitObservationConfig, sampler: Looker, samples: Samples) -> FovealObservationModel:
    """Fit the model with the method in the settings.

    Args:
        config: the settings.
        sampler: the source of the detections.
        samples: the labelled detections to fit on.

    Returns:
        The model.
    """
    if config.method != "discriminative":
        return fit_published(config, sampler, samples, config.method)
    start = fit_published(config, sampler, samples, "newton", expected="empirical")
    return fit_discriminative(start, samples.scores, samples.distance, samples.labels)


def fit_published(
    config: FitObservationConfig,
    sampler: Looker,
    samples: Samples,
    method: Method,
    **options: Any,
) -> FovealObservationModel:
    """Fit Dirichlet distributions to the scores of each class and level.

    A pair of class and level with enough detections is fitted by maximum likelihood, as published. Others are shrunk.

    Args:
        config: the settings.
        sampler: the source of the detections.
        samples: the labelled detections to fit on.
        method: method of the maximum-likelihood fit.
        options: further options of `FovealObservationModel.fit`.

    Returns:
        The model.
    """
    classes = sampler.eye.detector.classes
    model = FovealObservationModel.identity(classes, config.edges)
    with warnings.catch_warnings():
        # The report lists the levels that take the parameters of another level.
        warnings.simplefilter("ignore", UserWarning)
        return model.fit(
            statistics_of(model, samples),
            method=method,
            minimum=config.minimum,
            shrinkage=config.shrinkage,
            enough=config.enough,
            **options,
            **sampler.eye.settings(),
            samples=len(samples),
            data=sampler.scenes.fingerprint,
            fixations=config.fixations,
            seed=config.seed,
        ).eval()


def statistics_of(model: FovealObservationModel, samples: Samples) -> DirichletStatistics:
    """Compute the sufficient statistics of samples by class and level."""
    components, levels = model.alpha.shape[:2]
    statistics = DirichletStatistics((components, levels), components, epsilon=model.epsilon)
    return statistics.update(samples.scores, (samples.labels, model.level(samples.distance)))


def fit_all(
    config: FitObservationConfig, sampler: Looker, samples: Samples, model: FovealObservationModel
) -> dict[str, FovealObservationModel]:
    """Fit the models that the report compares: raw scores, the published estimators, and the requested model."""
    edges, classes = config.edges, sampler.eye.detector.classes
    models = {"raw scores": FovealObservationModel.identity(classes, edges).eval()}
    methods: tuple[Method, ...] = ("newton", "fixed_point", "gradient")
    for method in methods:
        models[f"Dirichlet, {method}"] = fit_published(config, sampler, samples, method)
    models["Dirichlet with class prior"] = fit_published(config, sampler, samples, "newton", prior=True)
    models["the same, tempered 0.1"] = fit_published(config, sampler, samples, "newton", prior=True, tempering=0.1)
    if config.method == "discriminative":
        models["discriminative"] = model
    return models
