"""Description of the machine on which results were measured."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import torch

from benchmarks.timing import Clock, interleaved

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


def copy_bandwidth(seconds: float, clock: Clock) -> float:
    """Bytes per second, read and written, of a copy between two arrays of 256 MB; the best of all repetitions."""
    source = torch.ones(2**26)
    target = torch.empty_like(source)
    times = interleaved({"copy": lambda: target.copy_(source)}, seconds, clock)["copy"]
    return 2 * source.numel() * source.element_size() / (min(times) / 1e3)
