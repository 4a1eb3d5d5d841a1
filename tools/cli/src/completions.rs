//! Completion in shells: the program itself is asked at every TAB, so that names of entries and experiments complete too.
//!
//! A script from [`script`] calls the program with [`VARIABLE`] set; [`answer`], first thing in `main`, answers and ends
//! it. clap's own script for bash splits words at `@` and `=`, which names of entries and settings hold; ours does not.

use std::ffi::{OsStr, OsString};
use std::io::Write;
use std::path::Path;

use anyhow::{Context, Result};
use clap::Command;
use clap_complete::CompleteEnv;
use clap_complete::engine::CompletionCandidate;
use clap_complete::env::{EnvCompleter, Fish, Shells, Zsh};

/// Set by the scripts: the program is asked what can stand at the cursor.
pub const VARIABLE: &str = "ACTRM_COMPLETE";

/// A shell that can be completed in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Shell {
    /// GNU bash, 4.4 or later.
    Bash,
    /// zsh.
    Zsh,
    /// fish.
    Fish,
}

const SHELLS: Shells<'static> = Shells(&[&Bash, &Zsh, &Fish]);

/// Answers a shell's question and ends the program; returns where none was asked.
pub fn answer(command: fn() -> Command) {
    CompleteEnv::with_factory(command).var(VARIABLE).shells(SHELLS).complete();
}

/// The script that makes a shell ask `program`.
///
/// # Errors
/// Never in practice: it is text in memory.
pub fn script(shell: Shell, program: &str) -> Result<String> {
    let completer: &dyn EnvCompleter = match shell {
        Shell::Bash => &Bash,
        Shell::Zsh => &Zsh,
        Shell::Fish => &Fish,
    };
    let mut text = Vec::new();
    completer.write_registration(VARIABLE, program, program, program, &mut text).context("cannot make the script")?;
    String::from_utf8(text).context("a completion script is text")
}

/// What was given for `option` in the line that is being completed, as `--zoo DIR` or `--zoo=DIR`.
pub fn given(option: &str) -> Option<OsString> {
    let mut words = std::env::args_os().skip_while(|word| word != "--").skip(1);
    while let Some(word) = words.next() {
        if word == option {
            return words.next();
        }
        if let Some(value) = word.to_str().and_then(|w| w.strip_prefix(option)).and_then(|w| w.strip_prefix('=')) {
            return Some(value.into());
        }
    }
    None
}

/// Names as candidates.
pub fn candidates(names: impl IntoIterator<Item = String>) -> Vec<CompletionCandidate> {
    names.into_iter().map(CompletionCandidate::new).collect()
}

/// bash, with words split at blanks only.
struct Bash;

/// Words are put together again where bash split them without a blank between; of every answer that part is taken away
/// which readline leaves standing before the cursor.
const BASH: &str = r#"_FUNCTION() {
    local words=() index=0 i word rest="$COMP_LINE"
    for ((i = 0; i < ${#COMP_WORDS[@]}; i++)); do
        word="${COMP_WORDS[i]}"
        if ((i > 0)) && [[ "$rest" != [[:blank:]]* ]]; then
            words[${#words[@]}-1]+="$word"
        else
            words+=("$word")
        fi
        rest="${rest#"${rest%%[![:blank:]]*}"}"
        rest="${rest#"$word"}"
        if ((i == COMP_CWORD)); then index=$((${#words[@]} - 1)); fi
    done
    local current="${words[index]}" standing=""
    if [[ "$current" == *[@=:]* ]]; then standing="${current%"${current##*[@=:]}"}"; fi
    local IFS=$'\n'
    COMPREPLY=($(VARIABLE=bash ACTRM_COMPLETE_INDEX=$index command "${words[0]}" -- "${words[@]}" 2>/dev/null))
    for i in "${!COMPREPLY[@]}"; do COMPREPLY[i]="${COMPREPLY[i]#"$standing"}"; done
    if [[ ${#COMPREPLY[@]} == 1 && "${COMPREPLY[0]}" == *[=/] ]]; then compopt -o nospace 2>/dev/null; fi
}
complete -o bashdefault -o default -F _FUNCTION PROGRAM
"#;

impl EnvCompleter for Bash {
    fn name(&self) -> &'static str {
        "bash"
    }

    fn is(&self, name: &str) -> bool {
        name == "bash"
    }

    fn write_registration(
        &self,
        variable: &str,
        name: &str,
        program: &str,
        _completer: &str,
        out: &mut dyn Write,
    ) -> std::io::Result<()> {
        let function = name.replace('-', "_");
        let script = BASH.replace("FUNCTION", &function).replace("PROGRAM", program).replace("VARIABLE", variable);
        out.write_all(script.as_bytes())
    }

    fn write_complete(
        &self,
        command: &mut Command,
        words: Vec<OsString>,
        folder: Option<&Path>,
        out: &mut dyn Write,
    ) -> std::io::Result<()> {
        let index = std::env::var("ACTRM_COMPLETE_INDEX").ok().and_then(|i| i.parse().ok()).unwrap_or_default();
        for candidate in clap_complete::engine::complete(command, words, index, folder)? {
            out.write_all(OsStr::as_encoded_bytes(candidate.get_value()))?;
            out.write_all(b"\n")?;
        }
        Ok(())
    }
}
