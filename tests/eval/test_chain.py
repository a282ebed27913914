"""The table of the chain step by step: means over photographs, and differences photograph by photograph."""

from eval.chain import chain_summary

POLICIES = ("as shipped", "set by hand", "learned")


def record(policy, scene, found_at):
    return {"policy": policy, "scene": scene, "found_at": found_at}


def test_the_table_has_means_over_photographs_and_paired_differences():
    # Two searches in the first photograph, one in the second.
    found_at = {
        "as shipped": {7: [-1, -1], 8: [4]},
        "set by hand": {7: [1, 6], 8: [3]},
        "learned": {7: [1, 2], 8: [6]},
    }
    records = [
        record(policy, scene, shift)
        for policy, scenes in found_at.items()
        for scene, shifts in scenes.items()
        for shift in shifts
    ]
    lines = [line.strip("| ").split(" | ") for line in chain_summary(records, 7).splitlines() if line.startswith("|")]
    rows = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in lines[2:]}
    assert [cell.strip() for cell in lines[0]] == ["policy", "CP@1", "CP@5"]
    assert list(rows) == [*POLICIES, *(f"{policy} - learned" for policy in POLICIES[:2])]
    # The standard error of two values is half their difference.
    assert rows["learned"] == ["25.0 ± 25.0", "50.0 ± 50.0"]
    assert rows["set by hand - learned"] == ["+0.0 ± 0.0", "+25.0 ± 75.0"]
    assert rows["as shipped - learned"] == ["-25.0 ± 25.0", "+0.0 ± 100.0"]


def test_the_caption_names_the_model_of_the_learned_chain():
    records = [record(policy, scene, 1) for policy in POLICIES for scene in (7, 8)]
    assert "*learned*: by the model that was fitted on the other folds." in chain_summary(records, 5)
    assert "*learned*: by `yolox-nano-search`." in chain_summary(records, 5, "yolox-nano-search")
