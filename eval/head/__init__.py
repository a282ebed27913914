"""A head that turns: `python -m eval.head` looks around in scenes that are larger than the eye's field of view.

    python -m eval.head                                                   # panoramas of embedded scenes
    python -m eval.head --data.root DIR --data.annotations instances.json --scenes 40
    python -m eval.head --data.root DIR --data.annotations instances.json --scene mosaic
    python -m eval.head --fields '[40, 80]'                                # the head can zoom, too

Our method moves eye and head by the expected gain per second. It is compared with a head that scans the scene in raster
order or in random order, with random movements of eye and head, and with an eye whose head does not move. The tables
give search results by seconds and by passes, and the success rate of explorations. To continue a stopped run, give the
same command again.
"""

from eval.head.report import head
from eval.head.run import HeadConfig
from semfov.runs.command import command

main = command(head, HeadConfig, __doc__)
