"""Drive cameras with libgphoto2: `client` is the driver, `process` the process of its own that loads the library."""
