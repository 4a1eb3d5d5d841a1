"""The Python side of actrm: one process, one robosuite environment, spoken to over a pipe.

`worker` is the program; `wire` and `protocol` are the frames and the messages in them; `suite` is robosuite behind
types; `envs` makes, seeds, steps and observes an environment and `render` draws it; `tasks` holds environments of our
own; `experts` are scripted controllers and `episodes` records what they do. Policies, clocks, time-outs and files are
Rust's business, not this package's.
"""

PROTOCOL = 1
