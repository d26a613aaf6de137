from pathlib import Path

import pytest

from extractors.addresses import Address, parsed
from extractors.errors import BadAddress
from extractors.wire import Medium


def address(text: str) -> Address:
    found = parsed(text)
    assert isinstance(found, Address)
    return found


def test_digits_are_a_camera_and_the_rest_is_a_path() -> None:
    assert parsed("2") == Address(Medium.CAMERA, "/dev/video2")
    assert parsed("./2") == Path("2")
    assert parsed("gate.mp4") == Path("gate.mp4")


@pytest.mark.parametrize(
    "text, shown",
    [
        ("rtsp://user:geheim@10.0.0.7:554/live/ch1?subtype=1", "rtsp://10.0.0.7:554/live/ch1"),
        ("http://camera/video.mjpg?user=admin&pwd=geheim#x", "http://camera/video.mjpg"),
        ("https://geheim@[fe80::1]:8443/", "https://[fe80::1]:8443/"),
        ("rtsps://camera.example", "rtsps://camera.example"),
    ],
)
def test_what_is_shown_holds_no_login(text: str, shown: str) -> None:
    found = address(text)
    assert found.shown == shown
    assert "geheim" not in repr(found) + found.shown + found.redacted(f"Opening {text} failed")


def test_a_password_is_taken_out_of_what_others_say_however_it_is_written() -> None:
    found = address("rtsp://user:ge%2Fheim@camera/1?token=abc")
    said = found.redacted("401 for user:ge%2Fheim, ge/heim, token=abc at camera")
    assert said == "401 for ***, ***, *** at camera"


def test_a_login_is_put_into_the_address() -> None:
    found = address("rtsp://camera/1")
    whole = found.with_login("user:a/b:c@d\n")
    assert whole.place == "rtsp://user:a%2Fb%3Ac%40d@camera/1"
    assert whole.shown == found.shown
    with pytest.raises(BadAddress, match="a login is one line `user:password`"):
        found.with_login("user")


@pytest.mark.parametrize(
    "text", ["ftp://host/x", "file:///etc/passwd", "rtsp://", "concat://a|b", "rtsp://host:99999/"]
)
def test_an_address_that_is_not_read_is_refused_without_repeating_it(text: str) -> None:
    with pytest.raises(BadAddress, match=r"an address must be rtsp://host/\.\.\., .*Next: ") as caught:
        parsed(text)
    assert "passwd" not in str(caught.value)
