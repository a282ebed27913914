"""The report on a fit of gaze habits: the gain of every term, and the tables of the model."""

from collections.abc import Sequence

from semfov.gaze.habits import GazeHabits
from semfov.runs.tables import table
from train.humanlike.habits import AGES, EDGES, FittedTerms, Halves

_TERMS = {"policy": "policy", "centre": "centre bias", "steps": "saccade length", "return": "return"}


def humanlike_report(halves: Halves, models: Sequence[FittedTerms], habits: GazeHabits) -> str:
    """Write the report as Markdown."""
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
    head = ["policy", "terms", "over the centre bias", "over a uniform choice", "over a uniform choice, fitted half"]
    steps = [f"up to {edge:g}" for edge in EDGES] + ["more"]
    ages = [f"{'' if low == high else f'{low:g} to '}{high:g}" for low, high in zip((1, 2, 3, 4), AGES, strict=True)]
    best = habits.metadata["policy"]
    return "\n".join(
        [
            "Information gain about people's next fixation, in bits per fixation (± standard error over pictures). "
            f"The models are fitted on {sizes['fitted_choices']} fixations of {sizes['fitted_people']} people in "
            f"{sizes['fitted_pictures']} pictures, and evaluated on {sizes['held_out_choices']} fixations of "
            f"{sizes['held_out_people']} other people in {sizes['held_out_pictures']} other pictures.",
            "",
            *table([head, *rows]),
            "",
            f"The model with all terms for the policy {best}: up to a constant, the log probability of a cell is the "
            f"sum of {float(habits.pull):.3f} times the policy's value (in standard deviations over the cells), the "
            "centre bias, and the following terms.",
            "",
            *table([["saccade length", *steps], ["steps", *(f"{v:+.2f}" for v in habits.step.tolist())]]),
            "",
            *table([["age in fixations", *ages, "more"], ["return", *(f"{v:+.2f}" for v in habits.back.tolist())]]),
            "",
            "Saccade lengths are in units of the image's longer side. The age of a cell is the number of fixations "
            "since it was last fixated.",
            "",
        ]
    )
