//! The pages in a browser: headless Chromium (`chromium` on the PATH, or `ACTRM_CHROMIUM`). Tests that need it are ignored
//! unless they are asked for; `make test` asks for them where there is a Chromium, and always in continuous integration.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use e2e::{data, lift, listing, refused, root, shipped, succeeds, text, zoo};

/// The browser.
fn browser() -> String {
    let named = std::env::var("ACTRM_CHROMIUM").ok();
    let names = named.into_iter().chain(["chromium", "chromium-browser", "google-chrome"].map(str::to_owned));
    names
        .into_iter()
        .find(|name| Command::new(name).arg("--version").output().is_ok_and(|output| output.status.success()))
        .expect("Chromium is on the PATH, or ACTRM_CHROMIUM names one")
}

/// The page after it has loaded, and what was said on its console, with further options of the browser.
fn rendered(browser: &str, page: &Path, options: &[&str]) -> (String, Vec<String>) {
    let profile = tempfile::tempdir().expect("a temporary folder");
    let output = Command::new(browser)
        .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr"])
        .args(["--window-size=1280,900", "--dump-dom"])
        .args(options)
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .arg(format!("file://{}", page.display()))
        .output()
        .expect("the browser runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let console = said.lines().filter(|line| line.contains("CONSOLE")).map(str::to_owned).collect();
    (String::from_utf8_lossy(&output.stdout).into_owned(), console)
}

/// Lets a reader, an async function that returns what it was told, at a page. A frame whose document stays open keeps the
/// page from having loaded until the reader is done, in real time, however busy the machine is; five minutes are enough.
const VISIT: &str = r##"<script>
addEventListener("DOMContentLoaded", async () => {
  const held = document.createElement("iframe");
  held.hidden = true;
  document.body.append(held);
  held.contentDocument.open();
  const done = () => held.contentDocument.close();
  setTimeout(done, 300_000);
  try {
    const told = await (READER)(PAGE);
    const out = document.createElement("pre");
    out.id = "told";
    out.textContent = JSON.stringify(told);
    document.body.append(out);
  } finally {
    done();
  }
});
</script>"##;

/// What a reader was told by a page.
fn visited(browser: &str, page: &Path, reader: &str, options: &[&str]) -> serde_json::Value {
    let html = fs::read_to_string(page).expect("a page");
    let (_, console) = rendered(browser, page, options);
    assert!(console.is_empty(), "{console:#?}");
    let quoted = serde_json::to_string(&html).expect("text").replace("</", "<\\/").replace("<!--", "<\\!--");
    let copy = page.with_extension("visited.html");
    // the last one: names of features may look like the end of a body
    let (before, after) = html.rsplit_once("</body>").expect("a body");
    let visit = VISIT.replace("READER", reader).replace("PAGE", &quoted);
    fs::write(&copy, format!("{before}{visit}</body>{after}")).expect("writable");
    let (dom, console) = rendered(browser, &copy, options);
    assert!(console.is_empty(), "{console:#?}");
    let (_, told) = dom.split_once("<pre id=\"told\">").expect("the reader came to an end");
    serde_json::from_str(told.split("</pre>").next().unwrap_or("")).expect("JSON")
}

/// Done by a reader: sorts, filters, opens a row by its link; then looks at the page at 390 pixels, in a frame.
const READER: &str = r##"async (page) => {
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
  told.open = [...document.querySelectorAll("details[open]")].map((details) => details.className);
  document.getElementById("copy").click();
  const focusable = [...document.querySelectorAll("a, button, input, select, summary, [tabindex]")];
  told.unreachable = focusable.filter((element) => element.tabIndex < 0).length;
  const frame = document.createElement("iframe");
  frame.width = 390; frame.height = 844;
  frame.srcdoc = page;
  await new Promise((loaded) => { frame.onload = loaded; document.body.append(frame); });
  const narrow = frame.contentDocument;
  narrow.querySelectorAll("details").forEach((details) => { details.open = true; });
  told.overflow = [800, 1280, 390].map((width) => {
    frame.width = width;
    return narrow.documentElement.scrollWidth - width;
  });
  // a cell of a first column holds a word, not a letter, in a line
  const firsts = [...narrow.querySelectorAll("#all tbody tr > :first-child, #overview tbody tr > :first-child")];
  told.firsts = Math.min(...firsts.map((cell) => cell.getBoundingClientRect().width));
  const boxes = [...document.querySelectorAll("#columns input")];
  const seen = () => heads.filter((head) => getComputedStyle(head).display !== "none").length;
  const before = seen();
  boxes.filter((box) => !box.checked)[0].click();
  told.columns = [heads.length, boxes.length, before, seen()];
  told.charts = [...narrow.querySelectorAll(".card > svg, .strip > svg, .costs > svg")].map((svg) => svg.getBoundingClientRect().width);
  told.lines = [...narrow.querySelectorAll(".lines > svg")].map((svg) => {
    const { width } = svg.getBoundingClientRect();
    const least = Math.min(...[...svg.querySelectorAll("text")].map((text) => parseFloat(narrow.defaultView.getComputedStyle(text).fontSize)));
    return [width, least * width / svg.viewBox.baseVal.width];
  });
  told.pairs = [...document.querySelectorAll("table.pairs")].map((pairs) => [
    pairs.rows.length, pairs.tHead.rows[0].cells.length, pairs.caption.textContent.length > 0,
    [...pairs.querySelectorAll(".better, .worse")].every((cell) => /[▲▼]/.test(cell.textContent)),
  ]);
  const commands = [...document.querySelectorAll("details[open] code.command")];
  const copies = [...document.querySelectorAll("button.copy")];
  told.copies = [copies.length, commands.length];
  let copied = "";
  Object.defineProperty(navigator, "clipboard", { value: { writeText: async (text) => { copied = text; } } });
  copies[0].click();
  told.copied = copied === commands[0].textContent && copied;
  frame.remove();
  return told;
}"##;

#[test]
#[ignore = "needs Chromium; `make test` runs it where there is one"]
fn the_report_works_in_a_browser() {
    let browser = browser();
    let folder = tempfile::tempdir().expect("a temporary folder");
    succeeds(&mut zoo(["leaderboard", "--zoo", text(&root().join("zoo")), "--out", text(folder.path())]));
    let page = folder.path().join("report.html");
    let told = visited(&browser, &page, READER, &[]);
    let numbers = |key: &str| -> Vec<f64> {
        told[key].as_array().expect("a list").iter().map(|x| x.as_f64().expect("a number")).collect()
    };
    let board = fs::read_to_string(folder.path().join("leaderboard.csv")).expect("the same rows");
    let tasks: Vec<&str> = board.lines().skip(1).filter_map(|row| row.split(',').nth(3)).collect();
    let (rows, lift) = (tasks.len(), tasks.iter().filter(|task| **task == "Lift").count());
    assert!(rows > lift && lift > 1, "{board}");
    assert_eq!(told["rows"], rows);
    let (down, up) = (numbers("down"), numbers("up"));
    assert!(down.is_sorted_by(|a, b| a >= b) && up.is_sorted() && up.len() == rows, "{down:?} {up:?}");
    assert_eq!(told["sort"], "ascending");
    assert_eq!(told["lift"], serde_json::json!(vec!["Lift"; lift]));
    assert_eq!(told["none"], format!("0 of {rows} rows"));
    assert!(told["target"].as_str().is_some_and(|hash| hash.starts_with("#door-act")), "{told}");
    assert_eq!((&told["open"], &told["unreachable"]), (&serde_json::json!(["task", "row"]), &0.into()), "{told}");
    // nothing but what scrolls by itself is wider than the page, and charts keep a size that can be read
    assert!(numbers("overflow").iter().all(|beyond| *beyond <= 0.0), "{told}");
    assert!(told["firsts"].as_f64().is_some_and(|width| width >= 100.0), "{told}");
    let [all, boxes, before, after] = [0, 1, 2, 3].map(|k| told["columns"][k].as_u64().expect("a count"));
    assert!(boxes + 1 == all && before < all && after == before + 1, "{told}");
    let charts = numbers("charts");
    assert!(charts.len() > 20 && charts.iter().all(|width| *width >= 300.0), "{charts:?}");
    // lines shrink with the page, and what is written in them does not
    let lines = told["lines"].as_array().expect("charts");
    let at = |pair: &serde_json::Value, place: usize| pair[place].as_f64().expect("a number");
    assert!(lines.len() > 5, "{told}");
    assert!(lines.iter().all(|pair| (300.0..=390.0).contains(&at(pair, 0)) && at(pair, 1) >= 10.0), "{lines:?}");
    // ACT beside ACTRM, and more, on every task: as many rows as columns, told apart by more than their colour
    let pairs = told["pairs"].as_array().expect("tables");
    assert!(pairs.len() > 5, "{told}");
    let sound = |pair: &serde_json::Value| pair[0] == pair[1] && (&pair[2], &pair[3]) == (&true.into(), &true.into());
    assert!(pairs.iter().all(sound), "{pairs:?}");
    // the row that was opened has a button for each of its commands, which copies it
    assert!(told["copies"][0] == told["copies"][1] && told["copies"][0].as_u64() > Some(1), "{told}");
    assert!(told["copied"].as_str().is_some_and(|line| line.starts_with("actrm-zoo ")), "{told}");
}

/// Done by a reader of a data set's page: opens an episode, looks for one, orders them; then looks at 390 pixels.
const VIEWER: &str = r##"async (page) => {
  const told = {};
  const settled = () => new Promise((done) => setTimeout(done, 60));
  const shown = () => [...document.querySelectorAll(".episode")].filter((episode) => !episode.hidden);
  told.episodes = shown().length;
  const episode = shown()[1];
  episode.querySelector("summary").click();
  await settled();
  told.points = [...episode.querySelectorAll(".line")].map((line) => line.getAttribute("d").match(/[ML]/g).length);
  told.pictures = await Promise.all([...episode.querySelectorAll("img")].map((image) => image.decode().then(() => image.naturalWidth)));
  told.captions = [...episode.querySelectorAll("figcaption")].map((caption) => caption.textContent);
  episode.querySelectorAll("details").forEach((details) => { details.open = true; });
  await settled();
  told.columns = [...episode.querySelectorAll(":scope > details > summary")].map((summary) => summary.textContent);
  told.all = episode.querySelectorAll(".line").length;
  const find = document.getElementById("find"), order = document.getElementById("order");
  order.value = "length";
  order.dispatchEvent(new Event("change", { bubbles: true }));
  told.lengths = shown().map((one) => +one.dataset.length);
  find.value = "nothing-like-this";
  find.dispatchEvent(new Event("input", { bubbles: true }));
  told.none = document.getElementById("shown").textContent;
  find.value = "";
  find.dispatchEvent(new Event("input", { bubbles: true }));
  location.hash = "#episode-0";
  await settled();
  told.linked = document.getElementById("episode-0").open;
  const focusable = [...document.querySelectorAll("a, button, input, select, summary, [tabindex]")];
  told.unreachable = focusable.filter((element) => element.tabIndex < 0).length;
  const frame = document.createElement("iframe");
  frame.width = 390; frame.height = 844;
  frame.srcdoc = page;
  await new Promise((loaded) => { frame.onload = loaded; document.body.append(frame); });
  const narrow = frame.contentDocument;
  narrow.querySelectorAll(".episode").forEach((details, i) => { details.open = i < 2; });
  await settled();
  told.overflow = [800, 1280, 390].map((width) => {
    frame.width = width;
    return narrow.documentElement.scrollWidth - width;
  });
  told.charts = [...narrow.querySelectorAll(".charts svg, .curves svg")].map((svg) => svg.getBoundingClientRect().width);
  frame.remove();
  return told;
}"##;

/// axe-core's findings of a page whose parts are all open: rule, impact and the first place.
const AXE: &str = r##"async () => {
  document.querySelectorAll("details").forEach((details) => { details.open = true; });
  const found = await axe.run(document, { resultTypes: ["violations"], iframes: false });
  return found.violations.map((rule) => [rule.id, rule.impact, rule.nodes[0].html.slice(0, 200)]);
}"##;

#[test]
#[ignore = "needs Chromium; `make test` runs it where there is one"]
fn pages_are_accessible_in_light_and_dark() {
    let browser = browser();
    let (folder, entries) = shipped(&["lift-act-s1", "lift-act-s2", "lift-actrm-s1", "lift-actrm-s2", "door-act-s1"]);
    succeeds(&mut zoo(["leaderboard", "--zoo", text(&entries), "--out", text(folder.path())]));
    viewed(folder.path());
    let packages = fs::read_dir(root().join(".venv/lib")).expect("`make venv` makes it");
    let python = packages.map(|entry| entry.expect("an entry").path()).find(|path| path.join("site-packages").is_dir());
    let axe = python.expect("a Python").join("site-packages/axe_playwright_python/axe.min.js");
    let axe = fs::read_to_string(axe).expect("axe-core");
    for name in ["report.html", "films.html", "file.html"] {
        let page = folder.path().join(name);
        let html = fs::read_to_string(&page).expect("a page");
        let (head, body) = html.split_once("</head>").expect("a head");
        let script = axe.replace("</script", "<\\/script");
        fs::write(&page, format!("{head}<script>{script}</script></head>{body}")).expect("writable");
        // 0 is dark
        for scheme in ["0", "1"] {
            let scheme = format!("--blink-settings=preferredColorScheme={scheme}");
            let found = visited(&browser, &page, AXE, &[&scheme]);
            assert_eq!(found, serde_json::json!([]), "{name} {scheme}");
        }
    }
}

fn films() -> PathBuf {
    root().join("crates/dataset/tests/fixtures/lerobot_video_av1")
}

/// Pages of a data set of videos and of a file: `films.html` and `file.html`.
fn viewed(folder: &Path) {
    for (source, out) in [(&films(), "films.html"), (&lift(), "file.html")] {
        let mut view = data(["view", text(source), "--frames", "3", "--points", "40", "--out"]);
        succeeds(view.arg(folder.join(out)));
    }
}

#[test]
fn the_page_of_a_data_set_says_what_is_in_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    let films = films();
    viewed(folder.path());
    // a page of the command is replaced, another file is not
    let first = fs::read(at("films.html")).expect("a page");
    let replaced = succeeds(&mut data(["view", text(&films), "--out", text(&at("films.html"))]));
    assert!(String::from_utf8_lossy(&replaced.stdout).contains("replaced"), "{replaced:?}");
    assert_ne!(fs::read(at("films.html")).expect("a page"), first);
    fs::write(at("own.html"), "<!doctype html>\n<p>mine</p>\n").expect("writable");
    let words = ["own.html: exists already and is no page of this command"];
    refused(&mut data(["view", text(&films), "--out", text(&at("own.html"))]), &words);
    assert_eq!(fs::read_to_string(at("own.html")).expect("there"), "<!doctype html>\n<p>mine</p>\n");
    fs::remove_file(at("own.html")).expect("removable");
    let mut asked = data(["view", text(&films), "--column", "reward", "--out"]);
    refused(asked.arg(at("x.html")), &["no column reward; there is action, observation.state"]);
    assert_eq!(listing(folder.path()), ["file.html", "films.html"]);
    let file = fs::read_to_string(at("file.html")).expect("a page");
    for said in ["50", "2,498", "robomimic HDF5", "Lift, version 1.5.2", "No problems found.", "return 11 · success"] {
        assert!(file.contains(said), "{said}");
    }
    assert!(!file.contains("http://") && !file.contains("https://"));
}

#[test]
#[ignore = "needs Chromium; `make test` runs it where there is one"]
fn a_data_set_is_viewed_in_a_browser() {
    let browser = browser();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    viewed(folder.path());
    let told = visited(&browser, &at("films.html"), VIEWER, &[]);
    assert_eq!((&told["episodes"], &told["all"]), (&3.into(), &5.into()), "{told}");
    // two cameras, three frames each, of an episode of 12 steps
    assert_eq!(told["pictures"], serde_json::json!([84, 84, 84, 84, 84, 84]), "{told}");
    assert_eq!(told["captions"].as_array().map(Vec::len), Some(6), "{told}");
    assert_eq!(told["columns"], serde_json::json!(["action (2)", "observation.state (3)"]), "{told}");
    let check = |told: &serde_json::Value| {
        let numbers = |key: &str| -> Vec<f64> {
            told[key].as_array().expect("a list").iter().map(|x| x.as_f64().expect("a number")).collect()
        };
        assert!(numbers("lengths").is_sorted_by(|a, b| a >= b), "{told}");
        assert!(told["none"].as_str().is_some_and(|text| text.starts_with("0 of ")), "{told}");
        assert_eq!((&told["linked"], &told["unreachable"]), (&true.into(), &0.into()), "{told}");
        assert!(numbers("overflow").iter().all(|beyond| *beyond <= 0.0), "{told}");
        let charts = numbers("charts");
        assert!(charts.len() > 3 && charts.iter().all(|width| *width >= 250.0), "{charts:?}");
        numbers("points")
    };
    assert_eq!(check(&told).len(), 2);
    let told = visited(&browser, &at("file.html"), VIEWER, &[]);
    assert_eq!(told["episodes"], 50);
    // seven actions, every second of an episode's 41 to 80 steps, or every one of fewer
    let points = check(&told);
    assert!(points.len() == 7 && points.iter().all(|n| (20.0..=40.0).contains(n)), "{points:?}");
}
