"""The cell's configuration: what counts, where it came from, and what is wrong is said with place, section and key."""

from itertools import combinations
from pathlib import Path

import pytest

from ftdrive.cell.config import (
    RULES,
    as_toml,
    load,
    settings,
    user_folder,
    variable,
)
from ftdrive.cell.rules import Rule
from ftdrive.errors import ConfigError

HEAD = 'format = "ftdrive.config/1"\n'
GOOD = HEAD + '[robot]\nhost = "10.0.0.2"\n[sensor]\nurl = "ati-can://can0"\n'


@pytest.fixture(autouse=True)
def _no_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "user"))


def write_user_file(text: str) -> None:
    user_folder("config").mkdir(parents=True)
    (user_folder("config") / "ftdrive.toml").write_text(text)


SOURCES = ("option", "variable", "project", "user")


@pytest.mark.parametrize("said", [said for n in range(1, 5) for said in combinations(SOURCES, n)], ids="+".join)
def test_the_first_that_says_it_counts(said: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = dict(zip(SOURCES, ("10.0.0.1", "10.0.0.2", "10.0.0.3", "10.0.0.4"), strict=True))
    if "user" in said:
        write_user_file(HEAD + f'[robot]\nhost = "{hosts["user"]}"\nmodel = "ur10e"\n')
    if "project" in said:
        Path("ftdrive.toml").write_text(HEAD + f'[robot]\nhost = "{hosts["project"]}"\n')
    if "variable" in said:
        monkeypatch.setenv("FTDRIVE_ROBOT_HOST", hosts["variable"])
    flags = {"robot.host": ("--robot", hosts["option"] if "option" in said else None)}
    origins = {
        "option": "--robot",
        "variable": "FTDRIVE_ROBOT_HOST",
        "project": "ftdrive.toml",
        "user": str(user_folder("config") / "ftdrive.toml"),
    }
    found = settings(None, flags)
    assert (found["robot.host"].value, found["robot.host"].origin) == (hosts[said[0]], origins[said[0]])
    assert found["robot.model"].origin == (origins["user"] if "user" in said else "not set")
    assert found["robot.speed_deg_s"].origin == "default"


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("robot.host", "10.0.0.9", "10.0.0.9"),
        ("robot.model", "ur5e", "ur5e"),
        ("robot.speed_deg_s", "45", 45.0),
        ("sensor.sign", "-1", -1),
        ("sensor.height_mm", "33.5", 33.5),
        ("tool.cylinders_mm", "[[0, 200, 100]]", ((0.0, 200.0, 100.0),)),
        ("workcell.measured", "true", True),
        ("workcell.mounting", "12.5", "12.5"),
    ],
)
def test_variables_are_read_as_the_key_needs(
    key: str, text: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable(key), text)
    assert settings()[key].value == value


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "FTDRIVE_ROBOT_SPEED_DEG_S",
            "fast",
            ["FTDRIVE_ROBOT_SPEED_DEG_S", "robot", "speed_deg_s", "fast", "a number"],
        ),
        ("FTDRIVE_ROBOT_SPEED_DEG_S", "4000", ["FTDRIVE_ROBOT_SPEED_DEG_S", "4000", "0.5 to 60"]),
        ("FTDRIVE_ROBOT_SPEED_DEG_S", "60\nmodel = 5", ["speed_deg_s", "a number"]),
        ("FTDRIVE_ROBOT_SPEED_DEG_S", "nan", ["a number"]),
        ("FTDRIVE_WORKCELL_MEASURED", "yes", ["true or false"]),
        ("FTDRIVE_TOOL_CYLINDERS_MM", "[[0, 200]]", ["cylinder"]),
        ("FTDRIVE_SENSOR_SIGN", "1.0", ["whole number"]),
        ("FTDRIVE_ROBOT_HOST", "", ["FTDRIVE_ROBOT_HOST", "empty", "unset"]),
        ("FTDRIVE_ROBOT_HOTS", "10.0.0.2", ["FTDRIVE_ROBOT_HOTS", "did you mean host", "the keys are host"]),
    ],
)
def test_a_variable_that_cannot_be_used_is_named(
    name: str, text: str, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, text)
    with pytest.raises(ConfigError) as error:
        settings()
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "format"),
        (GOOD.replace("/1", "/2"), "ftdrive.config/2"),
        (GOOD.replace("host", "hots"), "hots"),
        (GOOD.replace("[robot]", "[robots]"), "robots"),
        (GOOD.replace('"10.0.0.2"', "10"), "host"),
        (GOOD.replace('"10.0.0.2"', '" "'), "host.* empty"),
        (GOOD.replace('host = "10.0.0.2"', ""), "host"),
        (GOOD.replace("url", "sign = 1 #"), "url"),
        ("robot = 5\n" + HEAD, "robot"),
        (GOOD + "[sampling]\nattempts = 1.5\n", "attempts"),
        (GOOD + "[sampling]\naverage_s = inf\n", "average_s"),
        (GOOD + "[sampling]\naverage_s = 0\n", "0.05 to 600"),
        (GOOD + "[sampling]\nnoise_record_s = 2\n", "3 or more"),
        (GOOD.replace("host", "tip_speed_mm_s = 300\nhost"), "1 to 250"),
        (GOOD + "sign = true\n", "sign"),
        (GOOD + "sign = 0\n", "sign = 0.*-1 for"),
        (GOOD + "height_mm = 3300\n", "0 to 500"),
        (GOOD + "height_mm = 0.033\n", "the unit is mm"),
        (GOOD.replace("10.0.0.2", "http://10.0.0.2/"), "only a name or an IPv4 address"),
        (GOOD + "[robot", "TOML"),
        (GOOD + "[tool]\ncylinders_mm = " + "[" * 50_000, "TOML file: its brackets are nested too deeply"),
        (GOOD + '[site]\ng_m_s2 = "9.8"\n', "g_m_s2"),
        (GOOD + "[site]\ng_m_s2 = -9.8\n", "9.7 to 9.9"),
        (HEAD + '[robot]\nmodel = "ur6"\n', "UR5e"),
        (GOOD + "[tool]\ncylinders_mm = [0, 200, 100]\n", "list of lists"),
        (GOOD + "[tool]\ncylinders_mm = [[200, 100, 50]]\n", "cylinder"),
        (GOOD + "[tool]\ncylinders_mm = [[0, 200, 100, 5]]\n", "cylinder"),
        (GOOD + "[tool]\ncylinders_mm = [[0, 0.2, 0.1]]\n", "in mm"),
        (GOOD + "[tool]\ncylinders_mm = [[0, 60, 90], [60, 200, 4]]\n", "5 mm for a thinner part"),
        (GOOD + "[workcell]\nplanes_mm = [[0, 0, 0, 5]]\n", "plane"),
        (GOOD + "[workcell]\nboxes_mm = [[0, 0, 0, 1, 1, 0]]\n", "box"),
        (GOOD + "[workcell]\nboxes_mm = [[0.6, 0.6, 0, 0.8, 0.8, 0.2]]\n", "in mm"),
        (GOOD + '[workcell]\nmounting = "sideways"\n', "mounting"),
        (GOOD + "[workcell]\nmounting = 450\n", "-180 to 180"),
        (GOOD + '[workcell]\nmounting = "nan"\n', "mounting"),
        (GOOD + "[workcell]\nmeasured = 1\n", "measured"),
    ],
)
def test_errors_name_file_and_key(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=word) as error:
        load(path)
    assert str(path) in str(error.value) or "is not set" in str(error.value)


def test_the_readme_describes_every_key() -> None:
    def row(key: str, rule: Rule) -> str:
        default = settings()[key]
        shown = "" if default.value is None else f"`{as_toml(default.value)}`"
        return f"| `[{key.replace('.', '] ')}` | {shown} | {rule.range} | {rule.help} |"

    readme = (Path(__file__).parents[4] / "docs/reference/configuration.md").read_text(encoding="utf-8")
    rows = [line for line in readme.splitlines() if line.startswith("| `[")]
    assert rows == [row(key, rule) for key, rule in RULES.items()]


def test_a_password_of_the_store_reaches_no_file() -> None:
    """What runs and recordings keep of the configuration."""
    Path("ftdrive.toml").write_text(GOOD + '[store]\nurl = "postgresql+psycopg://lab:p@ss:w@host:5432/cells"\n')
    found = load()
    assert found.store.url == "postgresql+psycopg://lab:p@ss:w@host:5432/cells"
    assert found.to_dict()["store"] == {"url": "postgresql+psycopg://lab@host:5432/cells"}
    Path("ftdrive.toml").write_text(GOOD + '[store]\nurl = "store.sqlite"\n')
    with pytest.raises(ConfigError, match=r"\[store\] url = 'store.sqlite' cannot be used"):
        load()


@pytest.mark.parametrize(
    ("line", "cure"),
    [
        ("[site]\ng_m_s2 = '9.81'", "a number: give one such as"),
        ("[sampling]\nattempts = 1.5", "a whole number: give one such as 1,"),
        ("[workcell]\nmounting = true", "a string: put it in quotes"),
        ("[workcell]\nmeasured = 1", "true or false: give one of them"),
        ("[tool]\ncylinders_mm = [0, 60, 90]", r"such as \[\[0, 60, 90\]\]"),
    ],
)
def test_a_wrong_type_says_what_to_give(line: str, cure: str) -> None:
    Path("ftdrive.toml").write_text(f"{GOOD}{line}\n")
    with pytest.raises(ConfigError, match=cure):
        load()
