"""The simulators that a worker can hold, one folder each. `tasks` says which of them a task needs."""
