"""What a fit of gaze habits tells: what every term gains, and the tables of the model."""

from collections.abc import Sequence

from semfov.experiments.summary import table
from semfov.gaze.habits import GazeHabits
from semfov.training.habits import AGES, EDGES, Fitted, Halves

_TERMS = {"policy": "policy", "centre": "centre bias", "steps": "saccade length", "return": "return"}


def report(halves: Halves, models: Sequence[Fitted], habits: GazeHabits) -> str:
    """All of it, as Markdown."""
    sizes = halves.sizes
    rows = [
        [
            model.policy or "none",
            " + ".join(_TERMS[term] for term in model.terms),
            f"{model.gain:+.3f} ± {model.error:.3f}",
            f"{model.even:.3f}",
            f"{model.fitted:.3f}",
        ]
        for model in models
    ]
    head = ["policy", "terms", "over the centre bias", "over even odds", "over even odds, fitted half"]
    steps = [f"up to {edge:g}" for edge in EDGES] + ["more"]
    ages = [f"{'' if low == high else f'{low:g} to '}{high:g}" for low, high in zip((1, 2, 3, 4), AGES, strict=True)]
    best = habits.metadata["policy"]
    return "\n".join(
        [
            "Information about people's next fixation, in bits a fixation (± standard error over pictures), "
            f"fitted on {sizes['fitted_choices']} fixations of {sizes['fitted_people']} people in "
            f"{sizes['fitted_pictures']} pictures, and judged by {sizes['held_out_choices']} of "
            f"{sizes['held_out_people']} other people in {sizes['held_out_pictures']} other pictures.",
            "",
            *table([head, *rows]),
            "",
            f"The model with all terms by {best}: the cell is drawn with the logarithm of its probability, up to a "
            f"constant, {float(habits.pull):.3f} times the policy's value in standard deviations over the cells, plus "
            "the centre bias, plus the following.",
            "",
            *table([["length in longer sides", *steps], ["steps", *(f"{v:+.2f}" for v in habits.step.tolist())]]),
            "",
            *table([["age in fixations", *ages, "more"], ["return", *(f"{v:+.2f}" for v in habits.back.tolist())]]),
            "",
        ]
    )
