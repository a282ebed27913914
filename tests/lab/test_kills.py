"""The fixture `kill_when` kills commands while they run; otherwise the test fails."""

import sys
import time

import pytest

LONG = [sys.executable, "-c", "import sys, time; open(sys.argv[1], 'w').close(); time.sleep(600)"]


def test_a_command_is_killed_as_soon_as_the_condition_is_met(kill_when, tmp_path):
    start, mark = time.monotonic(), tmp_path / "mark"
    kill_when([*LONG, str(mark)], mark.exists)
    assert mark.exists()
    assert time.monotonic() - start < 300


def test_kill_when_fails_if_the_deadline_passes(kill_when, tmp_path):
    with pytest.raises(pytest.fail.Exception, match=r"nothing was killed.* within 0\.2 s"):
        kill_when([*LONG, str(tmp_path / "mark")], (tmp_path / "other").exists, seconds=0.2)


@pytest.mark.parametrize("code", [0, 3])
def test_kill_when_fails_if_the_command_has_ended(kill_when, tmp_path, code):
    call = [sys.executable, "-c", f"raise SystemExit({code})"]
    with pytest.raises(pytest.fail.Exception, match=f"nothing to kill.* exit code {code}"):
        kill_when(call, (tmp_path / "other").exists)


def test_kill_when_fails_if_the_command_ends_as_the_condition_is_met(kill_when, tmp_path):
    mark = tmp_path / "mark"

    def late():
        """The condition is met only after the command has ended."""
        if mark.exists():
            time.sleep(1)
        return mark.exists()

    call = [sys.executable, "-c", f"open({str(mark)!r}, 'w').close()"]
    with pytest.raises(pytest.fail.Exception, match="nothing to kill"):
        kill_when(call, late)


def test_options_reach_the_command(kill_when, tmp_path):
    kill_when([*LONG, "mark"], (tmp_path / "mark").exists, cwd=tmp_path)
