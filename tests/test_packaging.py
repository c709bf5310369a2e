"""What is installed from a wheel works on its own: models, schemas, the page's player and the command."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import mrtamp

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built with what is installed here so that nothing is downloaded."""
    for tool in ("pip", "hatchling"):
        if importlib.util.find_spec(tool) is None:
            pytest.skip(f"{tool} is not installed")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(ROOT)], check=True, capture_output=True)
    [file] = folder.glob("mrtamp-*.whl")
    return file


def test_wheel_holds_the_package_the_models_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    wanted = (
        "player.html",
        "py.typed",
        "models/robots/panda.urdf",
        "models/problems/handover.yaml",
        "models/suites/smoke.yaml",
    )
    for name in (*(f"mrtamp/{w}" for w in wanted), "mrtamp/models/schema/problem.schema.json"):
        assert name in names
    assert any(name.endswith("/LICENSE") for name in names)
    assert {name.split("/")[0] for name in names} == {"mrtamp", f"mrtamp-{mrtamp.__version__}.dist-info"}


def test_wheel_works_away_from_the_sources(wheel: Path, tmp_path: Path) -> None:
    home = tmp_path / "environment"
    venv.create(home, with_pip=False, symlinks=True)
    python = home / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-index", "--quiet"]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    # The dependencies come from this environment, but not its editable mrtamp: .pth files are not read there.
    site = next(home.glob("lib/python*/site-packages"))
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n", encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    code = (
        "import mrtamp, mrtamp.model_files as m; print(mrtamp.__file__); print(m.models_dir()); "
        "p = mrtamp.load_problem('handover'); print(len(p.robots))"
    )

    def run(*command: str | Path) -> str:
        done = subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True)
        return done.stdout

    lines = run(python, "-c", code).split()
    assert all(Path(line).is_relative_to(home) for line in lines[:2])
    assert lines[2] == "2"
    assert "handover" in run(home / "bin" / "mrtamp", "list")


def test_every_public_name_can_be_imported() -> None:
    for name in mrtamp.__all__:
        assert getattr(mrtamp, name) is not None
    assert set(mrtamp.__all__) <= set(dir(mrtamp))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = mrtamp.nonsense


def test_importing_mrtamp_is_quick() -> None:
    code = "import sys, mrtamp; assert not {'pydrake', 'numpy', 'scipy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
