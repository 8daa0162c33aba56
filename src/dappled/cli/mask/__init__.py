"""`dappled mask make|table|diffraction|design|plan|kit`: design a printed mask, draw it, and test it on the bench."""
