"""Plug in your own detector as an ONNX file, and fit an observation model to its scores away from the fovea.

Run it from a checkout: python -m examples.own_onnx_detector MODEL.onnx --out model.safetensors
Without a file, it uses that of YOLOX-nano, whose scores a few scenes cannot better. For real use, fit on thousands of
photographs with `train.fit_fom`.
"""

import argparse
from typing import NamedTuple

import torch
from torch import Tensor

import semfov
from semfov.detection.weights import fetch
from semfov.observation.matching import match

EDGES = [n * 50 / 640 for n in range(1, 8)]  # borders between levels of distance, in units of the image's longer side


class Samples(NamedTuple):
    """Detections from several fixations: score vectors, distances to the fovea, and true classes."""

    scores: Tensor  # (M, K+1)
    distances: Tensor  # (M,), in units of the image's longer side
    labels: Tensor  # (M,)


@torch.inference_mode()
def look_around(eye: semfov.Eye, scenes: semfov.EmbeddedScenes, looks: int) -> Samples:
    """Detect from random fixations in scenes."""
    generator = torch.Generator().manual_seed(0)
    samples = []
    for index in range(len(scenes)):
        scene = scenes[index]
        grid = semfov.Grid(10, 10, scene.size)
        cells = torch.randperm(len(grid), generator=generator)[:looks]
        for fixation in grid.centres[cells]:
            detections = eye(scene.image[None], fixation[None])[0]
            distances = grid.box_distance(detections.boxes, fixation)
            labels = match(detections.boxes, scene.boxes, scene.labels)
            samples.append(Samples(detections.scores, distances, labels))
    return Samples(*(torch.cat(column) for column in zip(*samples, strict=True)))


def fitted(samples: Samples, eye: semfov.Eye) -> semfov.FovealObservationModel:
    """Fit an observation model to detections of an eye."""
    classes = eye.detector.classes
    model = semfov.FovealObservationModel.identity(classes, EDGES)
    statistics = semfov.DirichletStatistics(model.alpha.shape[:2], len(classes) + 1)
    statistics.update(samples.scores, (samples.labels, model.level(samples.distances)))
    model.fit(statistics, minimum=1, prior=True, tempering=0.1, **eye.settings())
    return model.eval().requires_grad_(False)


def nats(probabilities: Tensor, labels: Tensor) -> float:
    """Compute the mean negative log likelihood of the true classes."""
    of_true_class = probabilities.gather(-1, labels[:, None])
    return float(-of_true_class.clamp(min=1e-6).log().mean())


def main() -> None:
    """Fit on some embedded scenes, evaluate on others, and search with the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", help="ONNX detector (default: YOLOX-nano)")
    parser.add_argument("--scenes", type=int, default=8, help="scenes to fit on (default: 8)")
    parser.add_argument("--looks", type=int, default=6, help="fixations in each scene (default: 6)")
    parser.add_argument("--out", default="model.safetensors", help="file to write (default: model.safetensors)")
    arguments = parser.parse_args()

    detector = semfov.load_detector(arguments.model or fetch("yolox-nano"))
    print(f"{detector.name} knows {len(detector.classes)} classes and takes pictures of {detector.input_size}")

    eye = semfov.Eye(semfov.Foveation(sigma=100.0), detector).eval()
    scenes = semfov.EmbeddedScenes(detector.classes, count=arguments.scenes, seed=1)
    samples = look_around(eye, scenes, arguments.looks)
    model = fitted(samples, eye)
    model.save(arguments.out)
    print(f"fitted to {len(samples.labels)} detections, written to {arguments.out}")

    others = semfov.EmbeddedScenes(detector.classes, count=2, seed=2)
    test = look_around(eye, others, arguments.looks)
    predictions = {"raw scores": test.scores, "fitted model": model.calibrate(test.scores, test.distances)}
    for name, probabilities in predictions.items():
        loss = nats(probabilities, test.labels)
        print(f"{name}: negative log likelihood of {loss:.2f} nats per detection on other scenes")

    observer = semfov.observers.Semantic(len(detector.classes) + 1, model)
    search = semfov.policies.Policy("predictive", model)
    explore = semfov.policies.Policy("kl", model)
    agent = semfov.ActivePerception(eye, (observer, search), (observer, explore)).eval()
    scanpath = agent.search(others[0].image, "person", start=0)
    print(f"person {'found' if scanpath.found else 'not found'} after {len(scanpath)} looks")


if __name__ == "__main__":
    main()
