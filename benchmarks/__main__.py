"""Measure semfov and other implementations (peers) in one run: `python -m benchmarks`.

Results are ratios of the times of two programs within one repetition, as median and quartiles over repetitions. With
one thread, the default, times are CPU times, which other work on the machine changes little. With more threads, times
are elapsed times. Results go to `benchmarks/results/NAME.md` and `NAME.json`.
"""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.beliefs import compiled, exploration, kaplan_update, kaplan_updates, predictive_search
from benchmarks.fits import dirichlets
from benchmarks.interleave import in_turn
from benchmarks.kernels import fixations, half, lookahead, pictures, pyramid, roc_curve
from benchmarks.rollouts import rollouts
from benchmarks.saliency import saliency, where_people_look
from benchmarks.sensor import foveation
from benchmarks.tables import begin, command, comparison_rows, page, ratios_of, table, write
from benchmarks.timing import Comparison, measure

COMPARISONS: tuple[Callable[[], Comparison], ...] = (
    lambda: foveation("opencv", reuse=False),
    lambda: foveation("opencv", reuse=True),
    lambda: foveation("kornia", reuse=False),
    lambda: foveation("kornia", reuse=True),
    pyramid,
    pictures,
    fixations,
    half,
    dirichlets,
    kaplan_update,
    kaplan_updates,
    compiled,
    predictive_search,
    lambda: exploration("KL divergence"),
    lambda: exploration("negative entropy"),
    lookahead,
    lambda: lookahead(classes=1203),
    roc_curve,
    lambda: saliency("VOCUS2"),
    lambda: saliency("Itti-Koch"),
    where_people_look,
    in_turn,
    rollouts,
)
TEXT = """\
Written by `python -m benchmarks`. Ratios of times are taken within one repetition and given as median (quartiles).
Above 1, semfov is faster. A peer that would take too long does a part of the work, and its time is scaled up. A limit
is what the ratio, or the time of semfov, is to keep."""
LIMITS = {
    ("foveation, opencv pyramid, pyramid included", "OpenCV, tuned"): "at least 0.83 on an Intel, 0.67 on an AMD",
    ("Gaussian pyramid", "cv2.pyrDown"): "at least 0.5 on an Intel, 0.33 on an AMD",
    ("Kaplan's rule, 30 detections in 1,000 episodes", "one at a time"): "at most 140 ms",
}
"""What a ratio, or a time, is to reach, by work and peer."""


@torch.inference_mode()
def main() -> None:
    """Measure everything and write the table."""
    parser = command("benchmarks", __doc__, seconds=4.0)
    parser.add_argument("--name", default="cpu", help="name of the result files")
    parser.add_argument("--before", type=Path, help="JSON of a run of earlier code on this machine, for a column")
    options = parser.parse_args()
    clock, about = begin(options)
    earlier = {} if options.before is None else ratios_of(json.loads(options.before.read_text(encoding="utf-8")))
    measured, rows = [], []
    for make in COMPARISONS:
        measured.append(measure(make(), options.seconds, clock))
        for work, peer, *figures in comparison_rows(measured[-1], earlier):
            rows.append([work, peer, *figures, LIMITS.get((work, peer), "")])
        print(" | ".join(rows[-1]), flush=True)
    head = ["work", "peer", "semfov, ms", "peer, ms", "peer / semfov", *(["before"] if earlier else []), "limit"]
    written = {"machine": about, "comparisons": [asdict(each) for each in measured]}
    write(options.out, options.name, page("Benchmarks", TEXT, about, table(head, rows)), written)


if __name__ == "__main__":
    main()
