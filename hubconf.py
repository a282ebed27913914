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


def yolov3_tiny_agent(kind: str = "recommended", **options: Any) -> _semfov.ActivePerception:
    """An agent that searches: `agent.search(image, "cup") -> semfov.Scanpath`.

    Args:
        kind: `recommended`, `published` or `raw`.
        options: of `semfov.ActivePerception.recommended`, `.published` or `.raw`.
    """
    agents = {
        "recommended": _semfov.ActivePerception.recommended,
        "published": _semfov.ActivePerception.published,
        "raw": _semfov.ActivePerception.raw,
    }
    if kind not in agents:
        raise _semfov.InputError(f"kind: expected {', '.join(agents)}, got {kind!r}")
    return agents[kind]("yolov3-tiny", **options)
