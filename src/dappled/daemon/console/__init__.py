"""The operator's console: one page, served by a process of its own that subscribes to the stream.

A page that loads the processor, a browser that stops reading, or a crash of this process does not affect the capture.
"""
