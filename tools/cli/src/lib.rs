//! What both programs print, ask and stop with.
//!
//! Text for people goes through [`print()`], [`note`] and [`Screen`]: a reader that has gone ends the output and nothing
//! else, names from files cannot command the terminal, a full disk is an error and no panic. [`Stop`] is Ctrl-C,
//! [`SimulatorArgs`] starts the simulators, [`limits`] refuses absurd sizes before any work, [`completions`] speaks with
//! shells, [`write_video()`] makes videos for people, and [`commands!`] lists a program's commands,
//! each named once.
//!
//! What this crate is not: it holds no logic of data, training or evaluation; those are the libraries'.

mod command;
pub mod completions;
pub mod limits;
mod output;
mod screen;
mod simulator;
mod stop;
mod table;
mod text;
mod video_writer;

pub use command::{dressed, end, every_command_shows_examples, parse};
pub use output::{Parents, make_parent, new_file, note, print, print_json, refuse_existing};
pub use screen::Screen;
pub use simulator::{SimulatorArgs, close};
pub use stop::{INTERRUPTED, Stop};
pub use table::{Column, Table, table};
pub use text::{bytes, command_line, count, lossy, number, plain, shape, shell_quoted, shown};
pub use video_writer::{VideoWriter, write_video};
