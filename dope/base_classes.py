"""The base classes of a table of splits: what a method may learn from, so that no class is tested that it has seen."""

from __future__ import annotations

from dope.common.errors import UsageError
from dope.lowshot.splits import SplitTable, match_categories
from dope.shard_index import read_table
from dope.storage import Shards, open_storage

TABLES = ("index.parquet", "views.parquet")
"""Of pairs and of single views; both have the objects' categories."""


def base_categories(shards: Shards, table: SplitTable) -> tuple[str, ...]:
    """The shards' categories that are base classes of a table, sorted: for `data.categories`.

    Names are matched ignoring case, underscores, hyphens and spaces, as `dope eval` does.

    Raises:
        UsageError: the table has no base classes, or the shards lack one of them.
        BadInput: the shards' tables cannot be read.
    """
    where = f"{table.name}, base classes"
    if not table.base:
        raise UsageError("there are none", where=where, remedy='Give them as "base" in the file of splits')
    storage = open_storage(shards)
    there: set[str] = set()
    for name in TABLES:
        if name in storage.sizes():
            columns, _ = read_table(storage, name, ("category",), may_be_null=("category",))
            there |= {str(category) for category in columns["category"].to_pylist() if category}
    return match_categories(table.base, there, where=where)[0]
