use std::process::ExitCode;

use cli::completions::{Shell, script};

/// Print a completion script for a shell
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo completions bash > ~/.local/share/bash-completion/completions/actrm-zoo
  actrm-zoo completions zsh > ~/.zfunc/_actrm-zoo
  actrm-zoo completions fish > ~/.config/fish/completions/actrm-zoo.fish")]
pub struct Args {
    /// Shell that the script is for
    shell: Shell,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    cli::print(&script(args.shell, "actrm-zoo")?)?;
    Ok(ExitCode::SUCCESS)
}
