from __future__ import annotations

import socket

import pytest

from automodel.web.access import CSP, Access


def test_tokens_have_256_bits_and_differ_and_are_not_shown() -> None:
    one, other = Access(), Access()
    assert len(one.token) >= 43  # of 6 bits each
    assert one.token != other.token
    assert one.token not in repr(one)


def test_only_the_whole_token_fits() -> None:
    access = Access()
    assert access.token_fits(access.token)
    for wrong in ("", access.token[:-1], access.token + "a", access.token.swapcase(), "\udc80", "ä"):
        assert not access.token_fits(wrong)


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1:8765",
        "localhost",
        "LOCALHOST:80",
        "[::1]:8765",
        "192.168.1.7:8765",
        f"{socket.gethostname()}.local:1",
    ],
)
def test_addresses_and_own_names_are_hosts(host: str) -> None:
    assert Access().host_fits(host)


@pytest.mark.parametrize(
    "host", [None, "", "evil.example", "localhost.evil.example:8765", "127.0.0.1.nip.io", "[::1", ":80"]
)
def test_other_names_are_none(host: str | None) -> None:
    assert not Access().host_fits(host)


@pytest.mark.parametrize(
    ("tls", "origin", "fits"),
    [
        (False, "http://10.0.0.2:8765", True),
        (False, "https://10.0.0.2:8765", False),
        (True, "https://10.0.0.2:8765", True),
        (True, "http://10.0.0.2:8765", False),
        (False, "http://10.0.0.2:8766", False),
        (False, "http://evil.example", False),
        (False, "null", False),
        (False, None, False),
    ],
)
def test_the_origin_is_the_page_itself(tls: bool, origin: str | None, fits: bool) -> None:
    assert Access(tls=tls).origin_fits(origin, "10.0.0.2:8765") is fits


def test_the_policy_allows_no_foreign_and_no_inline_script() -> None:
    rules = dict(rule.strip().split(" ", 1) for rule in CSP.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["script-src"] == "'self'"
    assert rules["frame-ancestors"] == "'none'"
