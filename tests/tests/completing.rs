//! Completion in bash, as a user presses TAB: commands, options, values, names of entries and experiments.

use std::fs;
use std::path::Path;
use std::process::Command;

use e2e::{copied_zoo, data, program, succeeds, text, zoo};

/// What bash offers at the end of `line`, in a folder with our programs on PATH. An entry is one whole word at the
/// cursor as bash splits it.
fn offered(folder: &Path, script: &Path, line: &str) -> Vec<String> {
    // bash splits words as it reads a line, at blanks and at the characters of COMP_WORDBREAKS
    let driver = r#"
        source "$1"
        line="$2"
        COMP_LINE="$line" COMP_POINT=${#line} COMP_TYPE=9 COMP_WORDS=()
        rest="$line"
        while [[ -n "$rest" ]]; do
            rest="${rest#"${rest%%[![:blank:]]*}"}"
            [[ -z "$rest" ]] && break
            if [[ "$rest" =~ ^[@=:]+ || "$rest" =~ ^[^@=:[:blank:]]+ ]]; then
                COMP_WORDS+=("${BASH_REMATCH[0]}")
                rest="${rest:${#BASH_REMATCH[0]}}"
            fi
        done
        [[ "$line" == *[[:blank:]] ]] && COMP_WORDS+=("")
        COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
        name="${COMP_WORDS[0]##*/}"
        command_line=$(complete -p "$name") || exit 1
        function=$(sed -E 's/.*-F ([^ ]+).*/\1/' <<<"$command_line")
        "$function" "${COMP_WORDS[0]}" "${COMP_WORDS[COMP_CWORD]}" "" 2>/dev/null
        printf '%s\n' "${COMPREPLY[@]}"
    "#;
    let programs = Path::new(program("actrm-zoo").get_program()).parent().expect("a folder").to_owned();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").expect("a PATH"));
    let mut command = Command::new("bash");
    command.args(["--norc", "-c", driver, "bash", text(script), line]).current_dir(folder).env("PATH", path);
    let output = succeeds(&mut command);
    String::from_utf8(output.stdout).expect("text").lines().map(str::to_owned).filter(|l| !l.is_empty()).collect()
}

#[test]
fn bash_completes_commands_options_and_names() {
    let (folder, entries) = copied_zoo();
    let folder = folder.path();
    let mut scripts = Vec::new();
    for (name, mut command) in [("zoo", zoo(["completions", "bash"])), ("data", data(["completions", "bash"]))] {
        let path = folder.join(name).with_extension("bash");
        fs::write(&path, succeeds(&mut command).stdout).expect("writable");
        scripts.push(path);
    }
    let zoo_offers = |line: &str| offered(folder, &scripts[0], line);
    let data_offers = |line: &str| offered(folder, &scripts[1], line);

    let commands = zoo_offers("actrm-zoo ");
    for command in ["train", "runs", "eval", "leaderboard", "list", "show", "verify"] {
        assert!(commands.iter().any(|word| word == command), "{command}: {commands:?}");
        // whatever stands after a command
        let options = zoo_offers(&format!("actrm-zoo {command} --"));
        assert!(options.iter().any(|word| word == "--help"), "{command}: {options:?}");
    }
    for command in data_offers("actrm-data ").iter().filter(|word| !word.starts_with('-') && *word != "help") {
        let options = data_offers(&format!("actrm-data {command} --"));
        assert!(options.iter().any(|word| word == "--help"), "{command}: {options:?}");
    }
    assert_eq!(zoo_offers("actrm-zoo lead"), ["leaderboard"]);
    assert_eq!(zoo_offers("actrm-zoo eval --epi"), ["--episodes"]);
    assert_eq!(data_offers("actrm-data convert --images "), ["png", "ppm"]);

    // names of entries, also behind the @ at which bash splits words
    assert_eq!(zoo_offers("actrm-zoo eval lift"), ["lift-act@1"]);
    assert_eq!(zoo_offers("actrm-zoo show lift-act@"), ["1"]);
    assert!(zoo_offers("actrm-zoo show nothing").is_empty());
    fs::rename(&entries, folder.join("elsewhere")).expect("moved");
    assert!(zoo_offers("actrm-zoo show lift").is_empty());
    assert_eq!(zoo_offers("actrm-zoo show --zoo elsewhere lift"), ["lift-act@1"]);
    assert_eq!(zoo_offers("actrm-zoo show --zoo=elsewhere lift"), ["lift-act@1"]);

    // composed experiments: a policy and a task, with the inputs that the task has
    assert_eq!(
        zoo_offers("actrm-zoo train bc_sta"),
        [
            "bc_stack",
            "bc_stack_image",
            "bc_stackcolor",
            "bc_stackcolor_image",
            "bc_stackthreecubes",
            "bc_stackthreecubes_image"
        ]
    );
    // files, where a path can stand
    assert_eq!(zoo_offers("actrm-zoo list --zoo else"), ["elsewhere/"]);
}

#[test]
fn the_other_shells_get_a_script_that_asks_the_program() {
    for shell in ["zsh", "fish"] {
        for mut command in [zoo(["completions", shell]), data(["completions", shell])] {
            let script = String::from_utf8(succeeds(&mut command).stdout).expect("text");
            assert!(script.contains("ACTRM_COMPLETE") && script.contains("actrm-"), "{shell}: {script}");
        }
    }
    // a variable of that name that asks nothing changes nothing
    succeeds(zoo(["list", "--experiments"]).env("COMPLETE", "bash"));
}
