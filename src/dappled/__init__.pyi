from dappled.products.opened import open as open

__version__: str
