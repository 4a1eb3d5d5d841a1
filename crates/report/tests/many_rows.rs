//! A page with more rows than its table shows at once, in a browser: sorting, filters, links and copies know them all.

#![allow(clippy::unwrap_used)]

mod common;

use common::{browser, results, visit};
use report::{Beside, Reading, rank, to_html};
use serde_json::json;

const READER: &str = r##"
const table = document.getElementById("all"), body = table.tBodies[0];
const heads = [...table.tHead.rows[0].cells];
const column = (name) => heads.findIndex((head) => head.textContent.startsWith(name));
const cells = (name) => [...body.rows].map((row) => row.cells[column(name)].textContent);
const place = () => document.getElementById("place").textContent;
const button = (id) => document.getElementById(id);
const filter = (name, value) => {
  const field = document.querySelector(`[data-filter="${name}"]`);
  field.value = value;
  field.dispatchEvent(new Event("input", { bubbles: true }));
};
told.elements = document.getElementsByTagName("*").length;
told.first = [body.rows.length, place(), button("previous").disabled, button("next").disabled];
// classes of the cells, and their nodes with every further line counted once: rows differ in how many lines a cell has
const form = (row) => [...row.cells].map((cell) =>
  `${cell.className}: ${[...cell.childNodes].map((node) => node.nodeName).join(" ").replace(/( BR SMALL)+/, " (BR SMALL)*")}`);
const forms = () => {
  const all = [...body.rows].map(form);
  return heads.map((_, column) => [...new Set(all.map((row) => row[column].replace(" (BR SMALL)*", "")))].join(" | "));
};
const written = forms();
button("next").click(); button("next").click();
told.last = [body.rows.length, place(), button("previous").disabled, button("next").disabled];
told.like_the_written = [written, forms()];
heads[column("rate")].querySelector("button").click();
told.best = cells("rate").slice(0, 3);
heads[column("rate")].querySelector("button").click();
told.worst = cells("rate").slice(0, 3);
filter("text", "entry-23@1"); filter("task", "Task49");
told.found = [cells("entry"), cells("task"), document.getElementById("shown").textContent];
location.hash = body.rows[0].id;
filter("text", "nothing-like-this");
dispatchEvent(new Event("hashchange"));
told.linked = [...document.querySelectorAll("tr.linked")].map((row) => row.cells[0].textContent + row.cells[column("task")].textContent);
told.after_link = document.getElementById("shown").textContent;
let copied = "";
document.execCommand = () => { copied = document.querySelector("textarea").value; };
Object.defineProperty(navigator, "clipboard", { value: undefined });
button("copy").click();
told.copied = copied.trim().split("\n").length;
told.header = copied.split("\n")[0].split(",").length === heads.length;
"##;

#[test]
#[ignore = "needs Chromium; `make test` runs it where there is one"]
fn rows_that_are_not_shown_yet_are_sorted_found_linked_and_copied() {
    let browser = browser().expect("Chromium is on the PATH, or ACTRM_CHROMIUM names one");
    let rows = rank(&results(1_200), &Reading::default());
    let told = visit(&browser, &to_html(&rows, &Beside::default()), READER);
    assert_eq!(told["first"], json!([500, "rows 1 to 500 of 1200", true, false]), "{told}");
    assert_eq!(told["last"], json!([200, "rows 1001 to 1200 of 1200", false, true]), "{told}");
    let [written, drawn] = [0, 1].map(|k| &told["like_the_written"][k]);
    assert_eq!(written, drawn, "rows that the script draws are like those that the page is written with");
    assert!(
        written.as_array().is_some_and(|columns| columns.iter().all(|column| column.as_str() != Some(""))),
        "{told}"
    );
    // entry k succeeds in k / 4 of 50 episodes
    assert_eq!(told["best"], json!(["10.0%", "10.0%", "10.0%"]), "{told}");
    assert_eq!(told["worst"], json!(["0.0%", "0.0%", "0.0%"]), "{told}");
    assert_eq!(told["found"], json!([["entry-23@1"], ["Task49"], "1 of 1200 rows"]), "{told}");
    assert_eq!(told["linked"], json!(["entry-23@1Task49"]), "{told}");
    assert_eq!(told["after_link"], "1200 of 1200 rows", "{told}");
    assert_eq!((&told["copied"], &told["header"]), (&1_201.into(), &true.into()), "{told}");
    assert!(told["elements"].as_u64().unwrap() < 80_000, "{told}");
}
