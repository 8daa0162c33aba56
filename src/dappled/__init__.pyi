from dappled.daemon.stream.subscriber import subscribe as subscribe
from dappled.drivers.camera import Camera as Camera
from dappled.products.opened import open as open

__version__: str
