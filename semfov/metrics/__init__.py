"""Measures of searches, explorations, probabilities, detections and scanpaths."""

import lazy_loader

from semfov.attribute_words import METRICS, missing

_MODULES = ["average_precision", "calibration", "episodes", "labels", "merging", "scanpath"]

_module, __dir__, __all__ = lazy_loader.attach(__name__, _MODULES)


def __getattr__(name: str) -> object:
    """Import a module when it is first asked for; name the module of a measure."""
    try:
        return _module(name)
    except AttributeError:
        raise missing("semfov.metrics", name, METRICS, __all__) from None
