"""What the command line says of itself, and of what is wrong with it."""

import os
import subprocess
import sys
from importlib.metadata import version

import pytest
import typer

from cell.apps.cli import main


@pytest.mark.parametrize("words", [["--help"], ["runs"], ["abort"], ["pause"], ["go-on"], ["confirm"]], ids=" ".join)
def test_a_command_that_has_to_be_quick_loads_nothing_heavy(tmp_path, words: list[str]):
    code = """
import atexit, sys
heavy = {"numpy", "cv2", "pinocchio", "scipy", "numba", "transitions"}
atexit.register(lambda: print("loaded:", *sorted(heavy & set(sys.modules))))
sys.argv = ["cell", *sys.argv[1:]]
from cell.apps.cli import main
main()"""
    run = tmp_path / "runs" / "20260101T000000-abcd"
    run.mkdir(parents=True)
    (run / "report.json").write_text('{"outcome": "placed", "simulated": ["rail"], "wall_s": 61.0}')
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1].strip() == "loaded:", done.stderr


@pytest.mark.parametrize(
    ("option", "shown"), [("--version", version("assembly-cell")), ("--show-completion", "complete")]
)
def test_the_command_line_tells_its_release_and_completes(option: str, shown: str, monkeypatch, capsys):
    # Else typer looks among the processes above this one for a shell, and a test need not have one there.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    monkeypatch.setattr(sys, "argv", ["cell", option, *(["bash"] if "completion" in option else [])])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    assert shown in capsys.readouterr().out


MODULES = {
    "absent": None,
    "leaves": "raise SystemExit(0)",
    "shadows": "def register(app):\n    app.command('abort')(lambda: print('mine'))\n",
}


@pytest.mark.parametrize("module", MODULES)
def test_commands_of_a_broken_package_do_not_take_the_others_with_them(tmp_path, module: str):
    info = tmp_path / "odd-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[assembly_cell.commands]\nodd = {module}:register\n")
    if (text := MODULES[module]) is not None:
        (tmp_path / f"{module}.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "-c", "from cell.apps.cli import main; main()", "abort", "--help"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])},
    )
    assert done.returncode == 0
    assert "End what is going on" in done.stdout or "abort" in done.stdout
    assert f"the commands of {module}:register cannot be used" in done.stderr


def test_a_prompt_that_nobody_answers_is_told_in_words(monkeypatch, capsys):
    def unanswered(*_: object, **__: object) -> None:
        raise typer.Abort

    monkeypatch.setattr(typer.Typer, "__call__", unanswered)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert "a question was not answered" in capsys.readouterr().err
