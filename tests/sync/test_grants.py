import pytest

from events import Station, station_name
from sync import GrantError, Grants, token_hash
from tests.sync.conftest import OTHER_TOKEN, TOKEN


def test_a_token_speaks_for_its_station_only() -> None:
    grants = Grants({"brno-2": token_hash(TOKEN), "oslo-1": token_hash(OTHER_TOKEN)})

    assert grants.station_of(TOKEN) == Station("brno-2")
    assert grants.station_of(OTHER_TOKEN) == station_name("oslo-1")
    assert grants.station_of(token_hash(TOKEN)) is None
    assert Grants({}).station_of(TOKEN) is None


@pytest.mark.parametrize(
    "hashes, words",
    [
        ({"../x": "0" * 64}, "station must be"),
        ({"brno-2": TOKEN}, "the grant of station brno-2 must be the SHA-256 of its token"),
        ({"brno-2": "0" * 64, "oslo-1": "0" * 64}, "stations brno-2 and oslo-1 share one token"),
    ],
)
def test_grants_that_cannot_be_meant_are_refused(hashes: dict[str, str], words: str) -> None:
    with pytest.raises(GrantError, match=words) as raised:
        Grants(hashes)
    assert TOKEN not in str(raised.value)


@pytest.mark.parametrize(
    "token", ["", "short", "with a space in it", "t\u00f6ken-t\u00f6ken-t\u00f6ken", "x" * 513, "x" * 20 + "\n"]
)
def test_a_token_that_is_none_is_refused_without_being_shown(token: str) -> None:
    with pytest.raises(GrantError) as raised:
        token_hash(token)
    assert not token or token not in str(raised.value)
