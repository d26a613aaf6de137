"""A request's signature: what it covers, and what it refuses."""

from collections.abc import Callable

import httpx
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from store import StationKey
from sync.errors import BadSignature
from sync.protocol import signing
from sync.protocol.signing import RequestSigner, Signed, content_digest, signed

PATH = "/sync/v2"
KEY = StationKey(Ed25519PrivateKey.generate())
OTHER = StationKey(Ed25519PrivateKey.generate())
CENTRAL = "c" * 32
KEYS = {KEY.id: KEY.public, OTHER.id: OTHER.public}


def request(endpoint: str = "segments", body: bytes = b"a body", key: StationKey = KEY) -> httpx.Headers:
    """The fields of a signed request, as central gets them."""
    signer = RequestSigner(key, "brno-2", CENTRAL, PATH)
    signer.answer("a challenge")
    signer.use("a-token")
    url = f"https://central.example/behind/a/proxy{PATH}/{endpoint}"
    return next(signer.auth_flow(httpx.Request("POST", url, content=body))).headers


def check(headers: httpx.Headers, endpoint: str = "segments", keys: dict[str, bytes] = KEYS) -> Signed:
    return signed(headers, PATH, endpoint, keys.get)


def test_a_signature_tells_the_key_and_all_that_it_covers() -> None:
    found = check(request())
    assert found.key_id == KEY.id
    assert found.values["content-digest"] == content_digest(b"a body")
    assert found.values["authorization"] == "Bearer a-token"
    assert (found.values["vian-central"], found.values["vian-number"]) == (CENTRAL, "1")


def test_a_hello_is_signed_over_its_challenge_and_an_enrolment_over_its_body() -> None:
    assert check(request("hello"), "hello").values["vian-challenge"] == "a challenge"
    assert check(request("enrol"), "enrol").values["content-digest"] == content_digest(b"a body")


def test_numbers_grow_within_a_session_and_begin_anew_with_the_next() -> None:
    signer = RequestSigner(KEY, "brno-2", CENTRAL, PATH)

    def number() -> str:
        sent = next(signer.auth_flow(httpx.Request("POST", f"http://x{PATH}/segments", content=b"")))
        return str(sent.headers["vian-number"])

    assert [number(), number()] == ["1", "2"]
    signer.use("next")
    assert number() == "1"


CHANGES: dict[str, Callable[[httpx.Headers], object]] = {
    name: lambda headers, name=name, value=value: headers.update({name: value})  # type: ignore[misc]
    for name, value in {
        "content-digest": content_digest(b"another body"),
        "content-length": "7",
        "authorization": "Bearer another",
        "vian-station": "oslo-1",
        "vian-central": "d" * 32,
        "vian-number": "2",
        "signature": "vian-sync=:" + "A" * 86 + "==:",
    }.items()
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_is_covered_cannot_be_changed(name: str) -> None:
    headers = request()
    CHANGES[name](headers)
    with pytest.raises(BadSignature) as refused:
        check(headers)
    assert (refused.value.key_id, refused.value.is_key_known) == (KEY.id, True)


def test_a_signature_for_one_endpoint_is_none_for_another() -> None:
    with pytest.raises(BadSignature):
        check(request("segments"), "countersign")


def test_a_field_given_twice_is_not_what_was_signed() -> None:
    headers = httpx.Headers([*request().multi_items(), ("vian-number", "2")])
    with pytest.raises(BadSignature):
        check(headers)


@pytest.mark.parametrize("missing", ["signature", "signature-input", "content-digest", "vian-number", "authorization"])
def test_nothing_that_must_be_covered_may_be_missing(missing: str) -> None:
    headers = request()
    del headers[missing]
    with pytest.raises(BadSignature):
        check(headers)


def test_a_signature_that_covers_less_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as weakened:
        weakened.setattr(signing, "covered_by", lambda _: signing.ENROL)
        headers = request()
    with pytest.raises(BadSignature, match="was not covered"):
        check(headers)


def test_an_unknown_key_and_another_stations_key_do_not_do() -> None:
    with pytest.raises(BadSignature) as refused:
        check(request(), keys={})
    assert (refused.value.key_id, refused.value.is_key_known) == (KEY.id, False)
    with pytest.raises(BadSignature):
        check(request(), keys={KEY.id: OTHER.public})


@pytest.mark.parametrize("field", ["signature", "signature-input"])
@pytest.mark.parametrize("garbage", ["", "x", "vian-sync=1", 'vian-sync=("@method");tag="vian-sync"', "a=:AA==:, b=?1"])
def test_garbage_is_no_signature(field: str, garbage: str) -> None:
    headers = request()
    headers[field] = garbage
    with pytest.raises(BadSignature):
        check(headers)


def test_what_the_lookup_of_a_key_raises_comes_through() -> None:
    def away(_: str) -> bytes | None:
        raise ConnectionError("the database is away")

    with pytest.raises(ConnectionError):
        signed(request(), PATH, "segments", away)
