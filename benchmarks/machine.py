"""The machine on which results are measured: its description, number of threads, and the photograph to work on."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import cv2
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from semfov.data import example
from semfov.detection.placement import resize

GAZE, SIGMA = (290.0, 280.0), 100.0
PACKAGES = ("torch", "kornia", "numpy", "opencv-python-headless", "scipy", "dirichlet")


def describe() -> dict[str, str]:
    """Processor, threads, load, versions and commit; the machine's name is left out."""
    root = Path(__file__).parents[1]
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True, check=False
    )
    return {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "load": f"{os.getloadavg()[0]:.1f} programs wanted a core in the minute before",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        **{name: version(name) for name in PACKAGES},
        "commit": commit.stdout.strip() or "unknown",
    }


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def photograph(width: int = 640, height: int = 480) -> Tensor:
    """Return a photograph that comes with the package, `(1, 3, height, width)`."""
    return resize(example("beach")[None], (width, height)).clamp(0, 1)


def use_threads(count: int) -> None:
    """Set the number of threads of torch, of OpenCV and of the matrix products of NumPy."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    threadpool_limits(count, user_api="blas")
