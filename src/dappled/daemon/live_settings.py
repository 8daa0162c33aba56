"""The settings in force while the daemon runs, and which of them may change in flight."""

from __future__ import annotations

from dataclasses import fields, replace

from dappled.config.settings import Settings

# Settings that are read each time they are used, and that change no record that has begun.
CHANGES_IN_FLIGHT = frozenset({("pose", "wait_ms"), ("record", "min_free_mb")})


class LiveSettings:
    """The settings in force: `now`."""

    def __init__(self, now: Settings) -> None:
        self.now = now

    def reload(self, wanted: Settings) -> list[str]:
        """Take over what may change in flight. Returns a sentence for each difference: taken, or refused."""
        changes: list[str] = []
        tables = {}
        for table in fields(Settings):
            old, new = getattr(self.now, table.name), getattr(wanted, table.name)
            taken = {}
            for key in fields(old):
                before, after = getattr(old, key.name), getattr(new, key.name)
                if before == after:
                    continue
                name = f"{table.name}.{key.name}"
                if (table.name, key.name) in CHANGES_IN_FLIGHT:
                    taken[key.name] = after
                    changes.append(f"{name} is {after!r} now (was {before!r})")
                else:
                    changes.append(f"{name} stays {before!r}: {after!r} takes a restart")
            tables[table.name] = replace(old, **taken)
        self.now = Settings(**tables)
        return changes
