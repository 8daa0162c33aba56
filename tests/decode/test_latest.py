from __future__ import annotations

from dappled.decode.latest import Latest


def test_the_latest_used_are_kept_and_made_only_once() -> None:
    made: list[str] = []

    def make(key: str) -> str:
        made.append(key)
        return key.upper()

    latest: Latest[str] = Latest(2)
    for key in ("a", "b", "a", "c", "a", "b"):
        assert latest.of(key, lambda key=key: make(key)) == key.upper()  # type: ignore[misc]  # a default binds the loop's value
    assert made == ["a", "b", "c", "b"]
    assert len(latest) == 2
