"""dappled: acquisition daemon for masked light-field cameras that fly."""

__version__ = "0.1.0"
