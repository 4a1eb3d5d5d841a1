"""robosuite 1.5: `suite` is it behind types, `envs` makes, seeds, steps and observes an environment.

`episodes` records what an expert does and looks at stored states;
`control*` is the compiled control loop's Python side, `render` draws images, `lean` and `lift_cube` make resets cheap.
"""
