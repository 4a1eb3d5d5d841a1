//! A program's commands and its end.

use std::ffi::OsString;
use std::process::ExitCode;

use anyhow::Result;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command, FromArgMatches};

/// Declares the commands of a program in the groups of its help: `commands! { "Data": convert, inspect; }`.
///
/// Each is a module of that name beside the call, with `Args`, whose doc comment is its help, and
/// `run(&Args) -> anyhow::Result<ExitCode>`. Makes the enum `Command` with its method `run`.
#[macro_export]
macro_rules! commands {
    ($($group:literal: $($name:ident),+ $(,)?);+ $(;)?) => {
        $($(mod $name;)+)+

        #[derive(clap::Subcommand)]
        #[allow(non_camel_case_types, clippy::large_enum_variant)]
        pub enum Command {
            $($(#[command(name = stringify!($name))] $name($name::Args)),+),+
        }

        impl Command {
            /// The commands, in the groups of the help.
            pub const GROUPS: &[(&str, &[&str])] = &[$(($group, &[$(stringify!($name)),+])),+];

            /// Runs the command; the code is what the program ends with.
            pub fn run(&self) -> anyhow::Result<std::process::ExitCode> {
                match self {
                    $($(Self::$name(args) => $name::run(args)),+),+
                }
            }
        }
    };
}

/// A program's command line in the form that all of ours have: commands in groups, short descriptions without a full stop,
/// and negative numbers as values, so that they are refused by name.
pub fn dressed(command: Command, groups: &[(&str, &[&str])]) -> Command {
    let command = tidied(command);
    let (head, name) = (*command.get_styles().get_header(), *command.get_styles().get_literal());
    let width = groups.iter().flat_map(|(_, names)| *names).map(|name| name.len()).max().unwrap_or_default();
    let mut template = "{before-help}{about-with-newline}\n{usage-heading} {usage}\n\n".to_owned();
    for (group, names) in groups {
        template.push_str(&format!("{head}{group}:{head:#}\n"));
        for command in names.iter().filter_map(|name| command.find_subcommand(name)) {
            let about = command.get_about().map(ToString::to_string).unwrap_or_default();
            template.push_str(&format!("  {name}{:width$}{name:#}  {about}\n", command.get_name()));
        }
        template.push('\n');
    }
    template.push_str(&format!("{head}Options:{head:#}\n{{options}}{{after-help}}"));
    command.help_template(template)
}

fn tidied(command: Command) -> Command {
    fn short(text: &clap::builder::StyledStr) -> String {
        let text = text.to_string();
        text.strip_suffix('.').map(str::to_owned).unwrap_or(text)
    }
    let about = command.get_about().map(short);
    let command = match about {
        Some(about) => command.about(about),
        None => command,
    };
    let arg = |arg: Arg| {
        let help = arg.get_help().map(short);
        let arg = match help {
            Some(help) => arg.help(help),
            None => arg,
        };
        if arg.is_positional() { arg } else { arg.allow_negative_numbers(true) }
    };
    command.mut_args(arg).mut_subcommands(tidied)
}

/// Reads the command line, or ends the program. `hint` may say more of an option that does not exist, with its value.
pub fn parse<T: FromArgMatches>(mut command: Command, hint: &dyn Fn(&str, Option<&str>) -> Option<String>) -> T {
    let words: Vec<OsString> = std::env::args_os().collect();
    let read = command.try_get_matches_from_mut(&words).and_then(|matches| T::from_arg_matches(&matches));
    read.unwrap_or_else(|mut error| {
        let unknown = match (error.kind(), error.get(ContextKind::InvalidArg)) {
            (ErrorKind::UnknownArgument, Some(ContextValue::String(option))) => Some(option.clone()),
            _ => None,
        };
        let told = unknown.and_then(|option| {
            let text = |word: &OsString| word.to_str().map(str::to_owned);
            let at = words.iter().position(|word| word.to_str().is_some_and(|word| word.starts_with(&option)));
            let joined = at.and_then(|at| text(&words[at])?.split_once('=').map(|(_, value)| value.to_owned()));
            let value = joined.or_else(|| text(words.get(at? + 1)?));
            hint(&option, value.as_deref())
        });
        if let Some(told) = told {
            error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![told.into()]));
        }
        error.exit()
    })
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
pub fn every_command_shows_examples(command: &Command) {
    command.clone().debug_assert();
    for sub in command.get_subcommands() {
        let help = sub.get_after_help().map(ToString::to_string).unwrap_or_default();
        let example = format!("{} {}", command.get_name(), sub.get_name());
        assert!(help.contains(&example), "`{}` shows no example", sub.get_name());
        assert!(sub.get_about().is_some(), "`{}` says nothing of itself", sub.get_name());
    }
}
