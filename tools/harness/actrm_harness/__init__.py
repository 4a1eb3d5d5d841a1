"""The Python side of actrm: one process, one environment of a simulator, spoken to over a pipe.

`worker` is the program; `wire` and `protocol` are the frames and the messages in them; `tasks` is the table of tasks;
`simulators` hold a folder for each simulator; `environments` are our own; `experts` are scripted controllers. Policies,
clocks, time-outs and files are Rust's business, not this package's.
"""

PROTOCOL = 2
PACKAGE = "actrm_harness"
