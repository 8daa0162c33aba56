"""The schema itself refuses what is no KML: a check that lets everything pass would be none."""

from __future__ import annotations

import pytest

from tests import globe

PAGE = (
    '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><GroundOverlay>{}'
    "</GroundOverlay></kml>"
)
BOX = "<LatLonBox><north>2</north><south>1</south><east>4</east><west>3</west></LatLonBox>"
QUAD = "<gx:LatLonQuad><coordinates>3,1 4,1 4,2 3,2</coordinates></gx:LatLonQuad>"


@pytest.mark.parametrize("inside", ["<name>a</name><Icon><href>a.png</href></Icon>" + BOX, QUAD, ""])
def test_what_the_schema_has_passes(inside: str) -> None:
    globe.check(PAGE.format(inside).encode())


@pytest.mark.parametrize(
    "inside",
    [
        BOX + "<name>a</name>",  # in another order
        BOX.replace("<north>2", "<north>181"),
        BOX.replace("<east>4", "<east>181"),
        BOX.replace("<west>3", "<west>far"),
        BOX.replace("LatLonBox", "LonLatBox"),
        QUAD.replace("LatLonQuad", "LatLonQuads"),
        QUAD.replace("gx:", ""),
    ],
)
def test_what_the_schema_has_not_fails(inside: str) -> None:
    with pytest.raises(AssertionError):
        globe.check(PAGE.format(inside).encode())
