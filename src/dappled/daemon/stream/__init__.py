"""What is published over ZeroMQ, and the subscriber at the other end."""
