"""The demonstration with the agent of a test."""

import pytest

import eval.demo as program


@pytest.fixture
def run(agent, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(program, "make_agent", lambda config: agent)
    monkeypatch.setattr(program, "known_classes", lambda config: None)

    def run_demo(*arguments):
        code = program.main([*map(str, arguments), "--out", str(tmp_path / "out")])
        return code, capsys.readouterr()

    return run_demo
