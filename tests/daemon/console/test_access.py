"""Who may speak to the console: every rule by the request that breaks it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import RecordedClock
from dappled.daemon.console import access
from dappled.daemon.console.access import Access, ConsoleRequest

TOKEN = "sesame-sesame-sesame"  # noqa: S105  # it opens nothing
HOST = {"host": "10.0.0.7:8080"}
OURS = {**HOST, "origin": "http://10.0.0.7:8080", "content-type": "application/json", "content-length": "2"}


def status(rules: Access, method: str, path: str, headers: dict[str, str], query: str = "") -> int:
    refusal = rules.judge(ConsoleRequest(method, path, headers, query))
    return 200 if refusal is None else refusal.status


@pytest.fixture
def rules() -> Access:
    return Access(TOKEN, ["drone.lan"])


@pytest.mark.parametrize(
    ("host", "code"),
    [
        ("127.0.0.1:8080", 200),
        ("localhost:8080", 200),
        ("LOCALHOST", 200),
        ("[::1]:8080", 200),
        ("drone.lan:8080", 200),
        ("10.0.0.7", 200),
        ("evil.example:8080", 421),
        ("", 421),
        ("127.0.0.1.evil.example", 421),
    ],
)
def test_it_answers_to_its_own_names_only(rules: Access, host: str, code: int) -> None:
    assert status(rules, "GET", "/", {"host": host}) == code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({}, 401),  # all is well but the token
        ({"origin": "http://evil.example"}, 403),
        ({"origin": ""}, 403),
        ({"origin": "null"}, 403),
        ({"content-type": "text/plain"}, 415),
        ({"content-type": "application/x-www-form-urlencoded"}, 415),
        ({"content-length": "99999"}, 413),
        ({"content-length": "x"}, 411),
        ({"content-length": ""}, 411),
        ({"content-length": "9" * 5000}, 413),
        ({"transfer-encoding": "chunked"}, 411),
        ({"transfer-encoding": "chunked", "content-length": "2"}, 411),
    ],
)
def test_only_the_page_itself_changes_anything(rules: Access, change: dict[str, str], code: int) -> None:
    assert status(rules, "POST", "/api/shoot", {**OURS, **change}) == code


def test_a_form_of_another_page_has_no_origin_of_ours(rules: Access) -> None:
    headers = {name: value for name, value in OURS.items() if name != "origin"}
    assert status(rules, "POST", "/api/shoot", headers) == 403


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "PATCH", "CONNECT"])
def test_other_methods_are_refused(rules: Access, method: str) -> None:
    assert status(rules, method, "/api/shoot", OURS) == 405


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({"cookie": f"{access.COOKIE}={TOKEN}"}, 200),
        ({"cookie": f"other=1; {access.COOKIE}={TOKEN}"}, 200),
        ({"authorization": f"Bearer {TOKEN}"}, 200),
        ({"authorization": f"Basic {TOKEN}"}, 401),
        ({"cookie": f"{access.COOKIE}=guess"}, 401),
        ({"authorization": "Bearer guess"}, 403),
        ({}, 401),
    ],
)
def test_the_token_opens(rules: Access, headers: dict[str, str], code: int) -> None:
    assert status(rules, "GET", "/api/state", {**HOST, **headers}) == code
    assert status(rules, "GET", "/static/main.js", HOST) == 200  # holds nothing that is not public


def test_a_globe_brings_the_token_in_its_address(rules: Access) -> None:
    assert status(rules, "GET", "/kml", HOST, f"token={rules.reading_token}") == 200
    assert status(rules, "GET", "/kml/7.png", HOST, f"token={rules.reading_token}") == 200
    assert status(rules, "GET", "/kml", HOST) == 401
    assert status(rules, "GET", "/kml", HOST, f"token={TOKEN}") == 403  # addresses end in logs
    assert status(rules, "GET", "/api/state", HOST, f"token={TOKEN}") == 401


def test_the_token_of_a_globes_address_opens_nothing_else(rules: Access) -> None:
    reads = rules.reading_token
    assert TOKEN not in reads
    for headers in ({"authorization": f"Bearer {reads}"}, {"cookie": f"{access.COOKIE}={reads}"}):
        assert status(rules, "GET", "/api/state", {**HOST, **headers}) in (401, 403)
        assert status(rules, "POST", "/api/shoot", {**OURS, **headers}) in (401, 403)
    assert status(rules, "POST", "/api/shoot", OURS, f"token={reads}") == 401
    assert rules.try_token(reads, "10.0.0.9") is not None
    assert Access("another-token-of-many-letters").reading_token != reads


def test_guesses_are_few() -> None:
    clock = RecordedClock(0)
    rules = Access(TOKEN, clock=clock)
    codes = [
        refusal.status if (refusal := rules.try_token(f"guess {n}", "10.0.0.9")) else 200
        for n in range(access.GUESSES + 2)
    ]
    assert codes == [403] * access.GUESSES + [429, 429]
    clock.advance(access.GUESS_WINDOW_S + 1)
    refusal = rules.try_token("guess", "10.0.0.9")
    assert refusal is not None
    assert refusal.status == 403
    assert rules.refused == access.GUESSES + 3


def test_the_right_token_is_let_in_whatever_was_guessed() -> None:
    rules = Access(TOKEN)
    for number in range(access.GUESSES + 2):
        rules.try_token(f"guess {number}", "10.0.0.9")
    assert rules.try_token(TOKEN, "10.0.0.9") is None


@pytest.mark.parametrize(("site", "code"), [("cross-site", 403), ("same-site", 403), ("same-origin", 429), ("", 429)])
def test_guesses_that_pages_of_other_sites_make_a_browser_bring_are_not_its_users(
    rules: Access, site: str, code: int
) -> None:
    headers = {**HOST, **({"sec-fetch-site": site} if site else {})}
    for number in range(access.GUESSES):
        assert status(rules, "GET", "/kml", headers, f"token={number}") == 403
    assert status(rules, "GET", "/kml", headers, "token=x") == code


def test_guesses_in_an_address_are_none_at_the_login(rules: Access) -> None:
    for number in range(access.GUESSES + 1):
        rules.judge(ConsoleRequest("GET", "/kml", HOST, f"token={number}", "10.0.0.9"))
    refusal = rules.try_token("mistyped", "10.0.0.9")
    assert refusal is not None
    assert refusal.status == 403


@pytest.mark.parametrize(
    ("stranger", "operator", "code"),
    [("10.0.0.9", "10.0.0.8", 403), ("2001:db8::1", "2001:db8:1::1", 403), ("2001:db8::1", "2001:db8::2", 429)],
)
def test_guesses_count_for_the_network_that_they_come_from(stranger: str, operator: str, code: int) -> None:
    rules = Access(TOKEN)
    for guess in range(access.GUESSES + 1):
        rules.try_token(f"guess {guess}", stranger)
    refusal = rules.try_token("mistyped", operator)
    assert refusal is not None
    assert refusal.status == code


def test_addresses_that_guess_are_not_remembered_without_end() -> None:
    rules = Access(TOKEN)
    for number in range(access.GUESSERS + 100):
        rules.try_token("guess", f"10.0.{number // 256}.{number % 256}")
    assert len(rules._guesses) == access.GUESSERS


@given(st.text(st.characters()))  # lone surrogates too: JSON can hold them
def test_any_text_is_judged_as_a_token(text: str) -> None:
    rules = Access(TOKEN)
    for token in (text, text + "\ud800", "é€"):
        refusal = rules.try_token(token, "10.0.0.9")
        assert refusal is not None
        assert refusal.status == 403


def test_without_a_token_loopback_is_open() -> None:
    rules = Access("")
    assert rules.open
    assert status(rules, "GET", "/api/state", {"host": "127.0.0.1:1"}) == 200
    assert status(rules, "POST", "/api/shoot", {**OURS, "origin": "http://evil.example"}) == 403


@given(
    st.sampled_from(["GET", "POST", "HEAD", "PUT"]),
    st.text(max_size=40),
    st.dictionaries(
        st.sampled_from(["host", "origin", "cookie", "authorization", "content-length"]), st.text(max_size=60)
    ),
    st.text(max_size=60),
)
def test_nothing_strange_gets_in(method: str, path: str, headers: dict[str, str], query: str) -> None:
    rules = Access(TOKEN)
    refusal = rules.judge(ConsoleRequest(method, "/api/" + path, headers, query))
    assert refusal is not None or path == "login"


def test_a_flood_of_wrong_tokens_is_a_few_lines_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    rules = Access("t" * 20, clock=RecordedClock(10**18))
    for number in range(500):
        assert rules.try_token(f"guess {number}", "10.0.0.5") is not None
        assert rules.judge(ConsoleRequest("GET", "/", {"host": f"evil{number}.example"}, "", "10.0.0.5")) is not None
    assert sorted(caplog.messages) == [
        "10.0.0.5: refused: a wrong token",
        "10.0.0.5: refused: it asked for a host name that is not in console.hosts",
        "10.0.0.5: refused: too many wrong tokens",
    ]
