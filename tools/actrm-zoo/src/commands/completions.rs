//! `actrm-zoo completions`

use std::process::ExitCode;

use clap::{Args, CommandFactory};
use clap_complete::Shell;

/// Print a completion script for a shell
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo completions bash > ~/.local/share/bash-completion/completions/actrm-zoo
  actrm-zoo completions fish > ~/.config/fish/completions/actrm-zoo.fish")]
pub struct CompletionsArgs {
    /// Which shell
    shell: Shell,
}

pub fn cmd_completions(args: &CompletionsArgs) -> anyhow::Result<ExitCode> {
    clap_complete::generate(args.shell, &mut crate::Cli::command(), "actrm-zoo", &mut std::io::stdout());
    Ok(ExitCode::SUCCESS)
}
