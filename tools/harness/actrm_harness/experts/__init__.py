"""Scripted experts: `parts` is what they share, the other modules hold them by kind of task."""
