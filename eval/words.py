"""Knowledge from words: `python -m eval.words` searches with and without context, from the same starts.

    python -m train.fit_context --embeddings glove.6B.300d.txt --weigh 400 --out runs/glove --name glove …
    python -m eval.words --tables "[runs/glove/glove.safetensors]" --data.root DIR --data.annotations instances.json

The arms: no context, context counted from annotations (the upper reference), context of each table, and of the same
table with its classes exchanged at random (the control). The tables have how many searches are found after so many gaze
shifts, and the difference to no context, search by search, with its standard error; then the same of those searches
alone whose first look misses the target, where context could matter most. In mosaics: `python -m eval.zoom --contexts`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.experiments.words import WordsConfig, words


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(words, WordsConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
