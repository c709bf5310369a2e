"""What README and CONTRIBUTING say is true: examples load, files and targets exist."""

from __future__ import annotations

import json
import re
from pathlib import Path

import jsonschema
import pytest
import yaml

import mrtamp
from mrtamp.cli import main

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """The fenced examples of README in `language`."""
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_problem_example_loads(tmp_path: Path) -> None:
    file = tmp_path / "problem.yaml"
    file.write_text(blocks("yaml")[0], encoding="utf-8")
    assert [r.name for r in mrtamp.load_problem(file).robots] == ["left", "right"]


def test_robot_example_follows_the_schema() -> None:
    schema = json.loads((ROOT / "models/schema/robot.schema.json").read_text(encoding="utf-8"))
    jsonschema.validate(yaml.safe_load(blocks("yaml")[1]), schema)


def test_python_example_names_what_exists() -> None:
    [code] = blocks("python")
    compile(code, "README.md", "exec")
    for name in re.findall(r"mrtamp\.(\w+)", code):
        assert hasattr(mrtamp, name)


@pytest.mark.parametrize("command", sorted(set(re.findall(r"mrtamp (list|plan|check|view|show)\b", README))))
def test_commands_exist(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    options = set(re.findall(rf"mrtamp {command}\b.*?(?=\n|\|)", README))
    text = capsys.readouterr().out
    assert all(flag in text for line in options for flag in re.findall(r"--[\w-]+", line))


@pytest.mark.parametrize("text", [README, CONTRIBUTING], ids=["README", "CONTRIBUTING"])
def test_links_and_targets_exist(text: str) -> None:
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", text):
        assert (ROOT / link).exists(), link
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
    assert set(re.findall(r"^    make ([a-z]+)", text, flags=re.MULTILINE)) <= targets


def test_modules_named_in_contributing_exist() -> None:
    rows = re.findall(r"^\| (`.*?) \|", CONTRIBUTING, flags=re.MULTILINE)
    for name in re.findall(r"`([\w*/]+)`", " ".join(rows)):
        assert list((ROOT / "src/mrtamp").glob(name.rstrip("/") + ("" if name.endswith("/") else ".py"))), name
