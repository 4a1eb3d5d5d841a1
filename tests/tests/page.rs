//! The report in a browser: headless Chromium, where it is installed (`chromium` on the PATH, or `ACTRM_CHROMIUM`).

use std::fs;
use std::path::Path;
use std::process::Command;

use e2e::{root, succeeds, text, zoo};

/// The browser, if there is one.
fn browser() -> Option<String> {
    let named = std::env::var("ACTRM_CHROMIUM").ok();
    let names = named.into_iter().chain(["chromium", "chromium-browser", "google-chrome"].map(str::to_owned));
    names
        .into_iter()
        .find(|name| Command::new(name).arg("--version").output().is_ok_and(|output| output.status.success()))
}

/// The page after its scripts have run, and what was said on its console.
fn rendered(browser: &str, page: &Path) -> (String, Vec<String>) {
    let profile = tempfile::tempdir().expect("a temporary folder");
    let output = Command::new(browser)
        .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr"])
        .args(["--window-size=1280,900", "--virtual-time-budget=4000", "--dump-dom"])
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .arg(format!("file://{}", page.display()))
        .output()
        .expect("the browser runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let console = said.lines().filter(|line| line.contains("CONSOLE")).map(str::to_owned).collect();
    (String::from_utf8_lossy(&output.stdout).into_owned(), console)
}

/// Done by a reader: sorts, filters, opens a row by its link; then looks at the page at 390 pixels, in a frame.
const READER: &str = r##"<script>
addEventListener("load", () => {
  const told = {};
  const table = document.getElementById("all");
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  const column = (name) => heads.findIndex((head) => head.textContent.startsWith(name));
  const values = (name) => [...body.rows].filter((row) => !row.hidden).map((row) => row.cells[column(name)].textContent);
  told.rows = body.rows.length;
  heads[column("rate")].querySelector("button").click();
  told.down = values("rate").map(parseFloat);
  heads[column("rate")].querySelector("button").click();
  told.up = values("rate").map(parseFloat);
  told.sort = heads[column("rate")].getAttribute("aria-sort");
  const filter = (name, value) => {
    const field = document.querySelector(`[data-filter="${name}"]`);
    field.value = value;
    field.dispatchEvent(new Event("input", { bubbles: true }));
  };
  filter("task", "Lift");
  told.lift = values("task");
  filter("text", "nothing-like-this");
  told.none = document.getElementById("shown").textContent;
  filter("task", ""); filter("text", "");
  document.querySelector("#overview a").click();
  dispatchEvent(new Event("hashchange"));
  told.target = location.hash;
  told.open = document.querySelectorAll("details[open]").length;
  document.getElementById("copy").click();
  const focusable = [...document.querySelectorAll("a, button, input, select, summary, [tabindex]")];
  told.unreachable = focusable.filter((element) => element.tabIndex < 0).length;
  const frame = document.createElement("iframe");
  frame.width = 390; frame.height = 844;
  frame.onload = () => {
    const narrow = frame.contentDocument;
    narrow.querySelectorAll("details").forEach((details) => { details.open = true; });
    told.overflow = narrow.documentElement.scrollWidth;
    told.charts = [...narrow.querySelectorAll(".card > svg, .strip > svg, .costs > svg")].map((svg) => svg.getBoundingClientRect().width);
    frame.remove();
    const out = document.createElement("pre");
    out.id = "told";
    out.textContent = JSON.stringify(told);
    document.body.append(out);
  };
  frame.srcdoc = PAGE;
  document.body.append(frame);
});
</script>"##;

#[test]
fn the_report_works_in_a_browser() {
    let Some(browser) = browser() else {
        eprintln!("skipped: no Chromium on the PATH; name one by ACTRM_CHROMIUM");
        return;
    };
    let folder = tempfile::tempdir().expect("a temporary folder");
    succeeds(&mut zoo(["leaderboard", "--zoo", text(&root().join("zoo")), "--out", text(folder.path())]));
    let page = folder.path().join("report.html");
    let html = fs::read_to_string(&page).expect("a report");
    let (_, console) = rendered(&browser, &page);
    assert!(console.is_empty(), "{console:#?}");

    let quoted = serde_json::to_string(&html).expect("text").replace("</", "<\\/");
    let reader = READER.replace("PAGE", &quoted);
    let visited = folder.path().join("visited.html");
    fs::write(&visited, html.replace("</body>", &format!("{reader}</body>"))).expect("writable");
    let (dom, console) = rendered(&browser, &visited);
    assert!(console.is_empty(), "{console:#?}");
    let told = dom
        .split("<pre id=\"told\">")
        .nth(1)
        .and_then(|rest| rest.split("</pre>").next())
        .expect("the reader came to an end");
    let told: serde_json::Value = serde_json::from_str(told).expect("JSON");
    let numbers = |key: &str| -> Vec<f64> {
        told[key].as_array().expect("a list").iter().map(|x| x.as_f64().expect("a number")).collect()
    };
    assert_eq!(told["rows"], 12);
    let (down, up) = (numbers("down"), numbers("up"));
    assert!(down.is_sorted_by(|a, b| a >= b) && up.is_sorted() && up.len() == 12, "{down:?} {up:?}");
    assert_eq!(told["sort"], "ascending");
    assert_eq!(told["lift"], serde_json::json!(["Lift", "Lift"]));
    assert_eq!(told["none"], "0 of 12 rows");
    assert!(told["target"].as_str().is_some_and(|hash| hash.starts_with("#door-act")), "{told}");
    assert_eq!((&told["open"], &told["unreachable"]), (&1.into(), &0.into()), "{told}");
    // at 390 pixels nothing but what scrolls by itself is wider, and charts keep a size that can be read
    assert!(told["overflow"].as_f64().is_some_and(|width| width <= 390.0), "{told}");
    let charts = numbers("charts");
    assert!(charts.len() > 20 && charts.iter().all(|width| *width >= 300.0), "{charts:?}");
}
