r"""Ask a language model for context: `python -m train.ask_language_model` makes a table of objects that occur together.

    python -m train.ask_language_model --url http://127.0.0.1:8080/v1 --model NAME --out runs/asked
    LANGUAGE_MODEL_KEY=… python -m train.ask_language_model --url https://HOST/v1 --model NAME --input_price 0.15 \
        --output_price 0.6 --budget 1

Any server with the chat-completions interface works. All questions are asked at temperature 0. Each answer is written
to `answers.jsonl` as soon as it arrives. If the command is interrupted, repeat it: it continues where it stopped and
pays for no question twice. The cost is computed from the numbers of tokens that the server reports.

The tables `beside.csv` and `heights.csv` serve as input for `python -m train.fit_context --table … --heights …`, which
evaluates them on photographs and fits their weights.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.ask import AskConfig, ask_language_model


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(ask_language_model, AskConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
