"""Entry points of `torch.hub`: `torch.hub.load("CHECKOUT", "eye", source="local")`."""

from typing import Any

import semfov as _semfov

dependencies = ["torch", "torchvision", "kornia", "numpy", "PIL", "safetensors", "pooch", "tqdm"]


def foveation(sigma: float = 100.0, **options: Any) -> _semfov.Foveation:
    """Make the foveal sensor.

    Args:
        sigma: width of the fovea in pixels, positive.
        options: further arguments of `semfov.Foveation`.

    Returns:
        The sensor.
    """
    return _semfov.Foveation(sigma, **options)


def detector(name: str = "yolox-nano", **options: Any) -> _semfov.Detector:
    """Load a detector with full score vectors.

    Args:
        name: name of the detector; the default one needs no network.
        options: options of `semfov.load_detector`.

    Returns:
        The detector.
    """
    return _semfov.load_detector(name, **options)


def observation(name: str = "yolox-nano") -> _semfov.FovealObservationModel:
    """Load the observation model that is shipped for a detector and a fovea of 100 pixels."""
    return _semfov.FovealObservationModel.from_pretrained(name)


def eye(name: str = "yolox-nano", sigma: float = 100.0, **options: Any) -> _semfov.Eye:
    """Make sensor and detector as one module: `eye(image, fixations) -> semfov.Detections`.

    Args:
        name: name of the detector.
        sigma: width of the fovea, in pixels of an image whose longer side is 640.
        options: options of `semfov.load_detector`.

    Returns:
        The eye, in `eval` mode.
    """
    return _semfov.Eye(foveation(sigma), detector(name, **options)).eval()


def agent(name: str = "yolox-nano", kind: str = "recommended", **options: Any) -> _semfov.ActivePerception:
    """Make an agent that searches: `agent.search(image, "cup") -> semfov.Scanpath`.

    Args:
        name: a detector with shipped models; with `raw`, any detector.
        kind: `recommended`, `published` or `raw`.
        options: options of the method of `semfov.ActivePerception` that has the name of the kind.

    Returns:
        The agent, in `eval` mode.

    Raises:
        semfov.InputError: the kind is unknown.
    """
    agents = {
        "recommended": _semfov.ActivePerception.recommended,
        "published": _semfov.ActivePerception.published,
        "raw": _semfov.ActivePerception.raw,
    }
    if kind not in agents:
        raise _semfov.InputError(f"kind: expected {', '.join(agents)}, got {kind!r}")
    return agents[kind](name, **options)
