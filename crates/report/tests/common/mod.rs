//! Many results, and a browser that opens their page: for a test and for the benchmark.

#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use zoo::results::{StoredEvaluation, list_evaluations};

/// Tasks that the results are of.
pub const TASKS: usize = 50;

/// Episodes of each.
const EPISODES: usize = 50;

/// As many results as are asked for: those of the repository under other names, with other outcomes.
pub fn results(count: usize) -> Vec<StoredEvaluation> {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo/results");
    let mut stored = list_evaluations(&shipped).unwrap();
    // rows of one form: ranked, and without groups of episodes
    let alike = |one: &StoredEvaluation| {
        one.record.training.policy.starts_with("act") && one.episodes.iter().all(|episode| episode.group.is_none())
    };
    stored.retain(|one| one.episodes.len() == 200 && alike(one));
    for one in &mut stored {
        one.record.seeds.count = EPISODES as u64;
        one.episodes.truncate(EPISODES);
        one.timings.truncate(EPISODES);
    }
    (0..count)
        .map(|k| {
            let (entry, task) = (k / TASKS, k % TASKS);
            let mut other = stored[task % stored.len()].clone();
            other.record.entry.name = format!("entry-{entry}");
            other.record.protocol.task = format!("Task{task}");
            for episode in &mut other.episodes {
                episode.success = (episode.seed as usize * 7919 + entry * 104_729) % EPISODES < entry / 4;
            }
            other
        })
        .collect()
}

/// Chromium, where there is one: `ACTRM_CHROMIUM`, or on the PATH.
pub fn browser() -> Option<String> {
    let named = std::env::var("ACTRM_CHROMIUM").ok();
    let mut names = named.into_iter().chain(["chromium", "chromium-browser", "google-chrome"].map(str::to_owned));
    names.find(|name| Command::new(name).arg("--version").output().is_ok_and(|output| output.status.success()))
}

/// Opens a page with `reader` behind it, the body of a function that is given `told` and fills it; what it was told.
pub fn visit(browser: &str, html: &str, reader: &str) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.html");
    let script = format!(
        "<script>\n(() => {{ const told = {{}};\n{reader}\nconst out = document.createElement(\"pre\"); out.id = \"told\";\n\
         out.textContent = JSON.stringify(told); document.body.append(out); }})();\n</script>"
    );
    let (before, after) = html.rsplit_once("</body>").unwrap();
    std::fs::write(&page, format!("{before}{script}</body>{after}")).unwrap();
    let output = Command::new(browser)
        .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1280,900"])
        .args(["--timeout=120000", "--enable-logging=stderr", "--dump-dom"])
        .arg(format!("--user-data-dir={}", folder.path().join("profile").display()))
        .arg(format!("file://{}", page.display()))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!said.contains("CONSOLE"), "{said}");
    let dom = String::from_utf8_lossy(&output.stdout);
    let told = dom.split("<pre id=\"told\">").nth(1).and_then(|rest| rest.split("</pre>").next());
    serde_json::from_str(told.unwrap_or_else(|| panic!("the page came to no end: {said}"))).unwrap()
}
