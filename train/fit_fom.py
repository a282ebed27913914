"""Fit a foveal observation model: `python -m train.fit_fom` learns how a detector scores what it sees off-centre.

    python -m train.fit_fom --data.root DIR --data.annotations instances.json --out runs/fit_fom

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is fixated at random points; detections are matched to the annotated boxes, and p(scores | class,
distance to the fovea) is fitted to them. The folder `out` gets the model (`<name>.safetensors`), a report that judges
it on photographs that it was not fitted on, and a reliability diagram. A run that was stopped goes on where it was;
more machines share the work under `torchrun`. Use the model with `--belief.model runs/fit_fom/<name>.safetensors`.
"""

import sys
import warnings
from collections.abc import Sequence

import semfov
from eval.command import run_command
from eval.parallel import rank
from eval.samples import Sampler, Samples, SampleSettings, collect
from semfov.errors import DataError, check
from semfov.observation import fit_discriminative
from train.config import FitConfig
from train.misses import count_misses
from train.report import write_report


def fit_fom(config: FitConfig) -> None:
    """Collect labelled detections, fit the model, judge it on held-out photographs, and write everything."""
    check(config.holdout >= 2, "holdout", "2 or more", config.holdout)
    settings = SampleSettings.of(config)
    sampler, samples = collect(settings, (config.cache or config.out) / "samples", config.workers, "looking")
    if rank() > 0:
        return
    held_out = samples.scene % config.holdout == 0
    if not held_out.any() or held_out.all():
        raise DataError(f"data: too few detections to fit on and to judge by ({len(samples)}); give more photographs")
    model = fit_model(config, sampler, samples[~held_out])
    fitted_on = {index for index in range(len(sampler.scenes)) if index % config.holdout != 0}
    model.miss_rate = count_misses(sampler, samples, fitted_on, model.edges).rates().to(model.edges)
    path = config.out / f"{config.name or sampler.eye.detector.name}.safetensors"
    model.save(path)
    written = write_report(config, model, fit_all(config, sampler, samples[~held_out], model), samples, held_out)
    print("written:")
    for file in [path, *written]:
        print(f"  {file}")


def fit_model(config: FitConfig, sampler: Sampler, samples: Samples) -> semfov.FovealObservationModel:
    """The model of the method that the settings name."""
    if config.method != "discriminative":
        return published_model(config, sampler, samples, config.method)
    start = published_model(config, sampler, samples, "newton", expected="empirical")
    return fit_discriminative(start, samples.scores, samples.distance, samples.labels)


def published_model(
    config: FitConfig, sampler: Sampler, samples: Samples, method: str, **options: object
) -> semfov.FovealObservationModel:
    """Dirichlets of maximum likelihood where a cell has enough detections, as published; others are shrunk."""
    classes = sampler.eye.detector.classes
    model = semfov.FovealObservationModel.identity(classes, config.edges)
    with warnings.catch_warnings():
        # The report tells which levels fell back.
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


def statistics_of(model: semfov.FovealObservationModel, samples: Samples) -> semfov.DirichletStatistics:
    """Sufficient statistics of samples by class and level."""
    components, levels = model.alpha.shape[:2]
    statistics = semfov.DirichletStatistics((components, levels), components, epsilon=model.epsilon)
    return statistics.update(samples.scores, (samples.labels, model.level(samples.distance)))


def fit_all(
    config: FitConfig, sampler: Sampler, samples: Samples, model: semfov.FovealObservationModel
) -> dict[str, semfov.FovealObservationModel]:
    """The models that the report compares: raw scores, the published estimators, and the model that was asked for."""
    edges, classes = config.edges, sampler.eye.detector.classes
    models = {"raw scores": semfov.FovealObservationModel.identity(classes, edges).eval()}
    for method in ("newton", "fixed_point", "gradient"):
        models[f"Dirichlet, {method}"] = published_model(config, sampler, samples, method)
    models["Dirichlet with class prior"] = published_model(config, sampler, samples, "newton", prior=True)
    models["the same, tempered 0.1"] = published_model(config, sampler, samples, "newton", prior=True, tempering=0.1)
    if config.method == "discriminative":
        models["discriminative"] = model
    return models


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_fom, FitConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
