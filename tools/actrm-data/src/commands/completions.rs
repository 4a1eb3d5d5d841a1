use anyhow::Result;
use cli::completions::{Shell, script};
use std::process::ExitCode;

/// Print a completion script for a shell
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data completions bash > ~/.local/share/bash-completion/completions/actrm-data
  actrm-data completions zsh > ~/.zfunc/_actrm-data
  actrm-data completions fish > ~/.config/fish/completions/actrm-data.fish")]
pub struct Args {
    /// Shell that the script is for
    shell: Shell,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    cli::print(&script(args.shell, "actrm-data")?)?;
    Ok(ExitCode::SUCCESS)
}
