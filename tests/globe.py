"""KML as its schema has it: OGC's for KML 2.2, with Google's for its extensions, both as fastkml ships them."""

from __future__ import annotations

import zipfile
from functools import cache
from importlib.metadata import distribution
from pathlib import Path

from lxml import etree


def check(document: bytes) -> None:
    """Fails with the schema's own words where a document is no valid KML."""
    schema = _schema()
    assert schema.validate(etree.fromstring(document)), str(schema.error_log)


def check_archive(path: Path) -> list[str]:
    """As `check`, for every page of a KMZ; the pages' names. What they link to must be in the archive."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        pages = [name for name in names if name.endswith(".kml")]
        for page in pages:
            document = archive.read(page)
            check(document)
            for href in etree.fromstring(document).iter("{*}href"):
                assert str(Path(page).parent / href.text) in names, f"{page} links to {href.text}"
    assert pages, f"no KML is in {path}"
    return pages


@cache
def _schema() -> etree.XMLSchema:
    """It includes what lies beside it, without the network."""
    return etree.XMLSchema(file=str(distribution("fastkml").locate_file("fastkml/schema/ogckml22.xsd")))
