"""Decide whether a target is present, where, and how surely: `python -m eval.decide` measures the agent's decisions.

    python -m eval.decide --data.root DIR --data.annotations instances.json --out runs/decide

Without photographs it uses the embedded scenes. In every photograph the agent searches for a class that is present and
for a class that is absent, until it decides: by windows, as it does by default, and with a fovea. Classes are drawn as
in the fit, so that the probabilities assume its share (`prior="fit"`). The tables give the area under the ROC curve of
the final probability, hit rates at several false alarm rates, and the decisions. For comparison they have plain rules
(one unfoveated pass, with one or two closer looks, with four quarters), the same belief with random gaze, and the
belief by Kaplan's rule with the same thresholds and with the rule of the published agent. Detections from every cell
are stored and shared with `python -m eval.search`. `--references false` leaves out what needs them, which takes a tenth
of the looks.
"""

from eval.comparison.model_folder import with_models
from eval.comparison.records import gather
from eval.comparison.summary import announce, sensing, write_files
from eval.decide.report import decision_summary, probabilities
from eval.decide.roc import plot_roc
from eval.decide.run import DecideConfig, DecisionRun
from semfov.errors import DataError
from semfov.runs.command import command
from semfov.runs.scene_run import finish
from semfov.viz.style import save_figure


def search_and_decide(config: DecideConfig) -> None:
    """Run the searches, and write their tables, records and ROC curves."""
    run = DecisionRun(with_models(config))
    finish(run, "deciding")
    stored = gather(run)
    records = [*stored]
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    text = decision_summary(records, sensing(run))
    written = write_files(run, "eval.decide", {"decisions.md": text}, records, stored.seconds)
    announce(text, [*written, save_figure(plot_roc(*probabilities(records)), config.out / "roc.png")])


main = command(search_and_decide, DecideConfig, __doc__)
