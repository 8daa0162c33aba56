"""The operator's console: one page, served by a process of its own that is fed by the publisher's sockets.

A page that loads the processor, a browser that stops reading, a crash in here: none of it touches the capture.
"""
