"""What all levels of tests share."""

import gc
import os
import signal
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import settings

pytest_plugins = ["tests.postgres"]

# A test run in the background inherits Ctrl-C as ignored, and so would every process that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)

gc.disable()  # while modules and tests are loaded, which stay to the end

# Before numpy is loaded: matrices are small, and the threads of two workers would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The tests ignore the configuration and the completed plans of the user who runs them.
_state = TemporaryDirectory(prefix="ftdrive-state-")
os.environ["XDG_CONFIG_HOME"] = _state.name + "/config"
os.environ["XDG_STATE_HOME"] = _state.name
os.environ["XDG_DATA_HOME"] = _state.name + "/data"
for _name in [name for name in os.environ if name.startswith("FTDRIVE_") and name != "FTDRIVE_REAL_DATA"]:
    del os.environ[_name]
# Nor do colours and width depend on the terminal in which the tests run.
for _name in (
    "COLORTERM",
    "COLUMNS",
    "FORCE_COLOR",
    "LINES",
    "NO_COLOR",
    "PY_COLORS",
    "TTY_COMPATIBLE",
    "TTY_INTERACTIVE",
):
    os.environ.pop(_name, None)
os.environ["TERM"] = "xterm-256color"
with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
    import_module("ftdrive.terminal.console")  # its consoles see here whether they print on a terminal
os.environ.pop("UV_RUN_RECURSION_DEPTH", None)  # or every command in a message would begin with `uv run`


def pytest_configure(config: pytest.Config) -> None:
    """Choose how many examples a property has, and keep the byte code of the processes that tests start.

    Each of those processes would otherwise compile numpy and scipy again.
    """
    settings.load_profile("fast" if "not slow" in config.option.markexpr and "CI" not in os.environ else "full")
    cache = getattr(config, "cache", None)  # none with `-p no:cacheprovider`
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", None) and cache is not None:
        os.environ["PYTHONPYCACHEPREFIX"] = str(cache.mkdir("bytecode"))


def pytest_collection_finish() -> None:
    """Leave the modules and some thousand tests out of what the garbage collector looks at."""
    gc.freeze()
    gc.enable()


settings.register_profile("fast", deadline=None, derandomize=True, max_examples=20)
settings.register_profile("full", deadline=None, derandomize=True, max_examples=60)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; they are not part of the project."""
    folder = os.environ.get("FTDRIVE_REAL_DATA")
    if not folder:
        pytest.skip("FTDRIVE_REAL_DATA is not set: the real recordings are not here")
    return Path(folder)
