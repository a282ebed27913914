"""IVSN over foveal looks: `python -m eval.ivsn` compares it with other searches, as `eval.search` does.

    python -m eval.ivsn --data.root val2017 --data.annotations instances_val2017.json --out runs/ivsn

The detector must give access to its features. Templates of YOLOv3-tiny are here; `python -m eval.ivsn.fit` fits
others. Without arguments the command searches the embedded scenes. It has all settings of `eval.search`.
"""

from eval.ivsn.run import IVSNConfig, IVSNRun
from eval.search.report import search_report
from semfov.runs.command import command
from semfov.runs.scene_run import finish


def ivsn(config: IVSNConfig) -> None:
    """Run the searches, and write tables, records and figures."""
    run = IVSNRun(config)
    finish(run, "searching")
    search_report(run)


main = command(ivsn, IVSNConfig, __doc__)
