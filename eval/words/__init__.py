"""Context from words: `python -m eval.words` compares searches with and without context, from the same starts.

    python -m train.fit_context --table beside.csv --weigh 400 --out runs/beside --name beside …
    python -m eval.words --tables "[runs/beside/beside.safetensors]" --data.root DIR --data.annotations instances.json

The arms are: no context; context counted from annotations (the upper reference); the context of each table; and that of
the same table with its classes permuted at random (the control). The tables give the share of targets found after n
gaze shifts, and the paired difference from no context with its standard error. A second table is restricted to searches
whose first look misses the target, where context could matter most.
"""

from collections.abc import Sequence

from eval.words.run import WordsConfig, words
from semfov.runs.command import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(words, WordsConfig, __doc__, arguments)
