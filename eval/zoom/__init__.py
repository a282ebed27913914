"""Pictures larger than the detector's input: `python -m eval.zoom` compares ways to choose place and magnification.

    python -m eval.zoom                                                   # mosaics of embedded scenes
    python -m eval.zoom --data.root DIR --data.annotations instances.json --mosaics 100
    python -m eval.zoom --data.root DIR --data.annotations instances.json --mosaics 0 --target person

It compares slices in raster order, in random order and ranked by the overview, a best-first quad-tree, our method, and
an oracle. The tables give recall after n passes of the detector, for mosaics the passes to the first confirmed hit, and
decisions. To continue a stopped run, give the same command again.
"""

from eval.zoom.report import zoom
from eval.zoom.run import ZoomConfig
from semfov.runs.command import command

main = command(zoom, ZoomConfig, __doc__)
