"""The model's functions, interpreted or compiled."""

from pathlib import Path

import pytest

from spacerobot_ros.model.compilation import find_compiler


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run in CasADi's virtual machine: most tests are about numbers, and compiling takes longer."""
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


@pytest.fixture(scope="session")
def _object_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("compiled")


@pytest.fixture
def compiled_code(monkeypatch: pytest.MonkeyPatch, _object_directory: Path) -> Path:
    """Run in generated C, kept in the folder that is returned; skip where there is no compiler."""
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(_object_directory))
    if find_compiler() is None:
        pytest.skip("no C compiler")
    return _object_directory
