"""Whether a wrong motion of a camera is believed: `python -m eval.poses` makes pairs of frames that are hard to match.

    python -m eval.poses --pictures [DIR,DIR] --out runs/poses

Without folders it uses the embedded photographs. Each kind of pair spoils views of photographs in one way: a cut, the
dark, bricks, a lorry before the camera, and others (`eval.poses.pairs`). The table counts films in which
`semfov.motion.CameraMotion` believes a motion that is wrong by more than five pixels of a frame 1920 pixels wide, in
the mean over the places that both frames show; those in which the motion of the last frame is believed and right; and
those in which it is doubted.
"""

from collections.abc import Sequence

from eval.poses.run import PosesConfig, judge_all
from semfov.runs.command import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(judge_all, PosesConfig, __doc__, arguments, goes_on=False)
