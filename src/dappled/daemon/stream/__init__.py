"""The stream over ZeroMQ: publisher, answers to questions, and the subscriber at the other end."""
