"""What a SIGHUP may change while the daemon flies, and what must wait for a restart."""

from __future__ import annotations

from dataclasses import fields, replace

from dappled.config.settings import Settings

# What is read each time it is used, and changes no record that has been begun.
SAFE: frozenset[tuple[str, str]] = frozenset(
    {
        ("pose", "wait_ms"),
        ("record", "min_free_mb"),
    }
)


def merge(now: Settings, wanted: Settings) -> tuple[Settings, list[str]]:
    """The settings from now on, and a sentence for each change: taken, or refused until a restart."""
    told: list[str] = []
    tables = {}
    for table in fields(Settings):
        old, new = getattr(now, table.name), getattr(wanted, table.name)
        taken = {}
        for key in fields(old):
            before, after = getattr(old, key.name), getattr(new, key.name)
            if before == after:
                continue
            name = f"{table.name}.{key.name}"
            if (table.name, key.name) in SAFE:
                taken[key.name] = after
                told.append(f"{name} is {after!r} now (was {before!r})")
            else:
                told.append(f"{name} stays {before!r}: {after!r} takes a restart")
        tables[table.name] = replace(old, **taken)
    return Settings(**tables), told
