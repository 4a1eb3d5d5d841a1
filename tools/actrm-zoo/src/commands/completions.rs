use std::process::ExitCode;

use cli::completions::{Shell, script};

/// Print a script that completes this command line in your shell
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo completions bash > ~/.local/share/bash-completion/completions/actrm-zoo
  actrm-zoo completions zsh > ~/.zfunc/_actrm-zoo
  actrm-zoo completions fish > ~/.config/fish/completions/actrm-zoo.fish")]
pub struct Args {
    /// Which shell
    shell: Shell,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    cli::print(&script(args.shell, "actrm-zoo")?)?;
    Ok(ExitCode::SUCCESS)
}
