"""The keys, checked against Zenoh's own matching."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.bus.keys import Keys, last_chunk, service_of
from vggt_motion.errors import ConfigurationError

KEYS = Keys("drive-7")
SHA = "0123456789abcdef" * 4
names = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)


def includes(wildcard: str, key: str) -> bool:
    return zenoh.KeyExpr(wildcard).includes(key)


def test_keys_are_those_of_the_design() -> None:
    assert KEYS.image("front") == "vggt_motion/@v1/drive-7/camera/front/image"
    assert KEYS.log("keyframe") == "vggt_motion/@v1/drive-7/log/keyframe"
    assert KEYS.rpc("ledger", "append") == "vggt_motion/@v1/drive-7/@rpc/ledger/append"
    assert KEYS.blob(SHA) == f"vggt_motion/@v1/drive-7/@rpc/ledger/blob/{SHA}"
    assert KEYS.alive("inference", "a1") == "vggt_motion/@v1/drive-7/alive/inference/a1"
    assert KEYS.health("inference", "a1") == "vggt_motion/@v1/drive-7/health/inference/a1"


def test_wildcards_match_what_they_should_and_nothing_else() -> None:
    concrete = {
        KEYS.all_images(): KEYS.image("front"),
        KEYS.all_logs(): KEYS.log("graph"),
        KEYS.all_blobs(): KEYS.blob(SHA),
        KEYS.all_alive(): KEYS.alive("ledger", "x"),
        KEYS.all_health(): KEYS.health("ledger", "x"),
    }
    for wildcard in concrete:
        assert [key for key in concrete.values() if includes(wildcard, key)] == [concrete[wildcard]]


def test_no_foreign_wildcard_reaches_us_or_our_calls() -> None:
    for key in (KEYS.image("front"), KEYS.rpc("jobs", "claim"), KEYS.log("event")):
        assert not includes("**", key)
        assert not includes("vggt_motion/**", key)
    assert includes("vggt_motion/@v1/drive-7/**", KEYS.log("event"))
    assert not includes("vggt_motion/@v1/drive-7/**", KEYS.rpc("jobs", "claim"))


@given(session=names, service=names, instance=names)
def test_every_accepted_name_makes_a_canonical_key(session: str, service: str, instance: str) -> None:
    keys = Keys(session)
    for key in (keys.alive(service, instance), keys.image(instance), keys.rpc(service, instance)):
        assert str(zenoh.KeyExpr(key)) == key
    assert service_of(keys.health(service, instance)) == (service, instance)
    assert last_chunk(keys.log(service)) == service
    assert (
        not includes(Keys(f"{session[:60]}x").all_alive(), keys.alive(service, instance))
        or f"{session[:60]}x" == session
    )


@pytest.mark.parametrize("name", ["", "a/b", "*", "**", "$*", "@v2", "a b", "ü", "a\n", "x" * 65, "a?b", "a#b"])
def test_names_that_would_change_a_key_are_refused(name: str) -> None:
    for make in (Keys, KEYS.image, KEYS.log, lambda part: KEYS.rpc(part, "x"), lambda part: KEYS.alive("x", part)):
        with pytest.raises(ConfigurationError, match="cannot be part of a key"):
            make(name)


@pytest.mark.parametrize("sha", ["", SHA[:-1], SHA.upper(), SHA + "0", "*"])
def test_only_a_hash_names_a_blob(sha: str) -> None:
    with pytest.raises(ConfigurationError, match="SHA-256"):
        KEYS.blob(sha)
