"""Entry points of `torch.hub`: `torch.hub.load("OWNER/semfov", "yolov3_tiny_eye")`."""

from typing import Any

import semfov as _semfov

dependencies = ["torch", "torchvision", "kornia", "numpy", "PIL", "safetensors", "pooch", "tqdm"]


def foveation(sigma: float = 100.0, **options: Any) -> _semfov.Foveation:
    """The foveal sensor; arguments of `semfov.Foveation`."""
    return _semfov.Foveation(sigma, **options)


def yolov3_tiny_detector(**options: Any) -> _semfov.Detector:
    """YOLOv3-tiny with full score vectors, its weights downloaded once; options of `semfov.load_detector`."""
    return _semfov.load_detector("yolov3-tiny", **options)


def yolov3_tiny_observation() -> _semfov.FovealObservationModel:
    """The observation model that is shipped for YOLOv3-tiny and a fovea of 100 pixels."""
    return _semfov.FovealObservationModel.from_pretrained("yolov3-tiny")


def yolov3_tiny_eye(sigma: float = 100.0, **options: Any) -> _semfov.Eye:
    """Sensor and detector as one module: `eye(image, fixations) -> semfov.Detections`; options of the detector."""
    return _semfov.Eye(foveation(sigma), yolov3_tiny_detector(**options)).eval()


def yolov3_tiny_agent(
    policy: str = "non-predictive", *, calibrated: bool = False, columns: int = 10, rows: int = 10, sigma: float = 100.0
) -> _semfov.ActivePerception:
    """An agent that searches: `agent.search(image, "cup") -> semfov.Scanpath`.

    Args:
        policy: name of a search policy (`semfov.search_policy`).
        calibrated: calibrate what is seen by the shipped observation model.
        columns: cells in a row of the belief.
        rows: cells in a column.
        sigma: width of the fovea.
    """
    model = yolov3_tiny_observation().requires_grad_(False)
    return _semfov.ActivePerception(
        foveation(sigma),
        yolov3_tiny_detector(),
        model if calibrated else None,
        (columns, rows),
        _semfov.search_policy(policy, model),
    ).eval()
