"""What is redacted in a text, and what a name in one file hides in another."""

import json

import pytest

from ftdrive.runs.bundle import Redaction


@pytest.mark.parametrize(
    "text", [json.dumps({"a": [{"path": r"C:\Users\bob\x"}]}), '{"path": "C:\\\\Users\\\\bob"}\nend']
)
def test_a_name_is_learnt_from_the_texts_of_json_without_their_escapes(text: str) -> None:
    redaction = Redaction()
    redaction.learn(text)
    assert redaction.file("of bob, not of bobby") == "of <user-1>, not of bobby"


def test_equal_values_have_equal_placeholders_of_their_kind() -> None:
    redaction = Redaction()
    for text in (
        "ati-netft://cell-7.example.org?x=1",
        "can://bus-9",
        "https://example.com/a",
        '{"host": "c3"}',
        '{"host": "q"}',
        "/home/root/x",
    ):
        redaction.learn(text)
    text = "10.1.2.3 and 10.1.2.4, 10.1.2.3; fe80::1 is no 12:30:45; cell-7 and cell-7.example.org, c3, bus-9, q, "
    text += "example.com"
    assert redaction.text(text) == (
        "<ip-1> and <ip-2>, <ip-1>; <ip-3> is no 12:30:45; <host-2> and <host-1>, <host-3>, bus-9, q, example.com"
    )
    assert redaction.counts == {"host": 3, "ip": 3}
    assert redaction.text("08:00:27:12:34:56 127.0.0.1 0.0.0.0 ::1 /home/root/a /home/u2/b") == (
        "<mac-1> 127.0.0.1 0.0.0.0 ::1 <home-1>/a <home-2>/b"
    )


def test_versions_and_measurements_on_a_wire_stay() -> None:
    redaction = Redaction()
    page, binary = b"Host: 192.168.7.31\r\n\t", b"192.168.7.31" + bytes(range(128, 132))
    document = {
        "versions": {"ur_rtde": "1.6.5.0"},
        "firmware": "5.15.0.17",
        "at": "5.15.0.17",
        "hex": page.hex(),
        "reply": binary.hex(),
        "request": "no hex of 192.168.7.31",
        "n": 3,
    }
    found = json.loads(redaction.file(json.dumps(document)))
    assert found == {
        **document,
        "at": "<ip-1>",
        "hex": page.replace(b"192.168.7.31", b"x" * 12).hex(),
        "request": "no hex of <ip-2>",
    }
