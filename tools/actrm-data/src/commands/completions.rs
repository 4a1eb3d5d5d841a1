use crate::output;
use anyhow::{Context, Result};
use clap_complete::Shell;
use std::process::ExitCode;

/// Print a script that completes this command line in your shell.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data completions bash > ~/.local/share/bash-completion/completions/actrm-data
  actrm-data completions zsh > ~/.zfunc/_actrm-data
  actrm-data completions fish > ~/.config/fish/completions/actrm-data.fish")]
pub struct Args {
    /// Shell to print it for
    shell: Shell,
}

pub fn run(args: &Args, command: &mut clap::Command) -> Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, command, "actrm-data", &mut script);
    output::print(&String::from_utf8(script).context("a completion script is text")?)?;
    Ok(ExitCode::SUCCESS)
}
