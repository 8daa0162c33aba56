"""Limits for what others wrote: sizes, nesting and digits are judged before memory is taken for them."""
