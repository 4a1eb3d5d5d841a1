//! A program's commands and its end.

use std::process::ExitCode;

use anyhow::Result;

/// Declares the commands of a program: `commands! { convert, inspect }`.
///
/// Each is a module of that name beside the call, with `Args`, whose doc comment is its help, and
/// `run(&Args) -> anyhow::Result<ExitCode>`. Makes the enum `Command` with its method `run`.
#[macro_export]
macro_rules! commands {
    ($($name:ident),+ $(,)?) => {
        $(mod $name;)+

        #[derive(clap::Subcommand)]
        #[allow(non_camel_case_types, clippy::large_enum_variant)]
        pub enum Command {
            $(#[command(name = stringify!($name))] $name($name::Args)),+
        }

        impl Command {
            /// Runs the command; the code is what the program ends with.
            pub fn run(&self) -> anyhow::Result<std::process::ExitCode> {
                match self {
                    $(Self::$name(args) => $name::run(args)),+
                }
            }
        }
    };
}

/// The end of a program: its exit code, or an error in one line on standard error.
pub fn end(result: Result<ExitCode>) -> ExitCode {
    if let Some(folder) = rollout::without_locks() {
        let folder = crate::shown(folder);
        crate::note(&format!(
            "note: {folder} is on a file system without locks: do not run two programs on the same folder at once"
        ));
    }
    match result {
        Ok(code) => code,
        Err(error) => {
            crate::output::complain(&format!("{error:#}"));
            ExitCode::FAILURE
        }
    }
}

/// For a program's tests: its command line is sound, and every command's help shows examples of it.
///
/// # Panics
/// If it is not so.
pub fn every_command_shows_examples(command: &clap::Command) {
    command.clone().debug_assert();
    for sub in command.get_subcommands() {
        let help = sub.get_after_help().map(ToString::to_string).unwrap_or_default();
        let example = format!("{} {}", command.get_name(), sub.get_name());
        assert!(help.contains(&example), "`{}` shows no example", sub.get_name());
        assert!(sub.get_about().is_some(), "`{}` says nothing of itself", sub.get_name());
    }
}
