"""Context from language: `python -m train.ask_language_model` fills a table of what is beside what by asking a model.

    python -m train.ask_language_model --url http://127.0.0.1:8080/v1 --model NAME --out runs/asked
    LANGUAGE_MODEL_KEY=… python -m train.ask_language_model --url https://HOST/v1 --model NAME --input_price 0.15 \\
        --output_price 0.6 --budget 1

The server is any with the chat-completions interface; every question is asked at temperature 0. Answers are kept in
`answers.jsonl` as they come: a command that was stopped goes on where it was when it is given again, and a question is
never paid for twice. Tokens are counted as the server counts them. `beside.csv` and `heights.csv` go to
`python -m train.fit_context --table … --heights …`, which judges them on photographs and fits how much they count.
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
