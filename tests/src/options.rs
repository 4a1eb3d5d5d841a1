//! docs/reference/options.md: every option of an experiment, read from the structs that configure it. Their doc comments are the
//! documentation; their `Default`, `configs/base.toml` and the policy's file are the defaults.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use crate::root;

/// A field of a struct, or a variant of an enum.
#[derive(Debug, Clone, Default)]
struct Part {
    name: String,
    /// of a field its type, of a variant what it holds
    holds: String,
    doc: String,
    attributes: String,
    /// what a variant with named fields holds
    fields: Vec<Part>,
}

/// A struct or an enum.
#[derive(Debug, Clone, Default)]
struct Item {
    file: PathBuf,
    name: String,
    is_enum: bool,
    attributes: String,
    parts: Vec<Part>,
}

/// All sources of the crates that configure something, and what they define.
struct Sources {
    texts: BTreeMap<PathBuf, String>,
    items: Vec<Item>,
}

fn rust_files(folder: &Path, into: &mut Vec<PathBuf>) {
    for item in fs::read_dir(folder).expect("a folder of sources").flatten() {
        let path = item.path();
        match path.is_dir() {
            true => rust_files(&path, into),
            false if path.extension().is_some_and(|e| e == "rs") => into.push(path),
            false => {}
        }
    }
}

/// The structs and enums of a source as rustfmt writes it.
fn items(file: &Path, text: &str) -> Vec<Item> {
    let (mut found, mut item): (Vec<Item>, Option<Item>) = (Vec::new(), None);
    let mut next = Part::default();
    for line in text.lines() {
        let trimmed = line.trim_start();
        let depth = line.len() - trimmed.len();
        if let Some(doc) = trimmed.strip_prefix("///") {
            next.doc.push_str(doc);
        } else if trimmed.starts_with("#[") {
            next.attributes.push_str(trimmed);
        } else if let Some(open) = &mut item {
            let Part { doc, attributes, .. } = std::mem::take(&mut next);
            let code =
                trimmed.trim_start_matches("pub(super) ").trim_start_matches("pub(crate) ").trim_start_matches("pub ");
            if line == "}" {
                found.extend(item.take());
            } else if depth == 4 && !trimmed.starts_with(['/', '}']) {
                let (name, holds) = match open.is_enum {
                    false => code.trim_end_matches(',').split_once(": ").unwrap_or((code, "")),
                    true => match code.find([' ', '(']) {
                        Some(at) => (&code[..at], code[at..].trim_end_matches(',')),
                        None => (code.trim_end_matches(','), ""),
                    },
                };
                open.parts.push(Part {
                    name: name.to_owned(),
                    holds: holds.to_owned(),
                    doc,
                    attributes,
                    ..Part::default()
                });
            } else if depth == 8
                && open.is_enum
                && let (Some(last), Some((name, holds))) = (open.parts.last_mut(), code.split_once(": "))
            {
                let (name, holds) = (name.to_owned(), holds.trim_end_matches(',').to_owned());
                last.fields.push(Part { name, holds, doc, attributes, ..Part::default() });
            }
        } else {
            let code = trimmed.trim_start_matches("pub(super) ").trim_start_matches("pub ");
            let (kind, rest) = code.split_once(' ').unwrap_or_default();
            if depth == 0 && matches!(kind, "struct" | "enum") && rest.ends_with(" {") {
                let name = rest.trim_end_matches(" {").split('<').next().unwrap_or_default().to_owned();
                let attributes = std::mem::take(&mut next.attributes);
                item =
                    Some(Item { file: file.to_owned(), name, is_enum: kind == "enum", attributes, parts: Vec::new() });
            }
            next = Part::default();
        }
    }
    found
}

/// `MeanStd` -> `mean_std`
fn snake(name: &str) -> String {
    let mut text = String::new();
    for (n, c) in name.chars().enumerate() {
        if c.is_ascii_uppercase() && n > 0 {
            text.push('_');
        }
        text.push(c.to_ascii_lowercase());
    }
    text
}

/// Parts of `text` between commas that are in no bracket and no string.
fn split_top(text: &str) -> Vec<String> {
    let (mut parts, mut depth, mut quoted) = (vec![String::new()], 0, false);
    for c in text.chars() {
        match c {
            '"' => quoted = !quoted,
            '(' | '[' | '{' if !quoted => depth += 1,
            ')' | ']' | '}' if !quoted => depth -= 1,
            _ => {}
        }
        match (c, depth, quoted) {
            (',', 0, false) => parts.push(String::new()),
            _ => parts.last_mut().expect("never empty").push(c),
        }
    }
    parts.into_iter().map(|part| part.trim().to_owned()).filter(|part| !part.is_empty()).collect()
}

/// What `Option<…>`, `BTreeMap<String, …>` and `Vec<…>` hold.
fn inside<'t>(kind: &'t str, outer: &str) -> Option<&'t str> {
    kind.strip_prefix(outer)?.strip_suffix('>')
}

/// A sentence of a doc comment, for a table.
fn sentence(doc: &str) -> String {
    let doc = doc.trim().replace('|', "\\|");
    let mut letters = doc.chars();
    let first: String = letters.next().into_iter().flat_map(char::to_uppercase).collect();
    let end = if doc.ends_with(['.', '?']) { "" } else { "." };
    format!("{first}{}{end}", letters.as_str())
}

/// `section.key` and value of a TOML file's plain lines.
fn plain_toml(text: &str) -> BTreeMap<String, String> {
    let (mut section, mut found) = (String::new(), BTreeMap::new());
    for line in text.lines() {
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            section = format!("{name}.");
        } else if let Some((key, value)) = line.split_once(" = ").filter(|_| !line.starts_with('#')) {
            found.insert(format!("{section}{key}"), value.to_owned());
        }
    }
    found.retain(|key, _| !key.starts_with("for."));
    found
}

/// What the file of a policy sets, with those that it extends.
fn policy_file(name: &str) -> BTreeMap<String, String> {
    let path = root().join(format!("configs/policy/{name}.toml"));
    let Ok(text) = fs::read_to_string(path) else { return BTreeMap::new() };
    let own = plain_toml(&text);
    let mut all = own.get("extends").map(|below| policy_file(below.trim_matches('"'))).unwrap_or_default();
    all.extend(own);
    all
}

/// Whether a key of a policy's file is a setting of other sections.
fn is_setting(key: &str) -> bool {
    key.contains('.') && !key.starts_with("policy.")
}

impl Sources {
    fn read() -> Self {
        let mut files = Vec::new();
        for folder in ["nn", "models", "solvers", "zoo", "study"] {
            rust_files(&root().join("crates").join(folder).join("src"), &mut files);
        }
        files.sort();
        let texts: BTreeMap<PathBuf, String> =
            files.into_iter().map(|file| (file.clone(), fs::read_to_string(file).expect("a source"))).collect();
        let items = texts.iter().flat_map(|(file, text)| items(file, text)).collect();
        Self { texts, items }
    }

    /// What `name` is in `file`: defined there, named by one of its `use` lines, or the only one of its name.
    fn find(&self, name: &str, file: &Path) -> Option<&Item> {
        let of_name = || self.items.iter().filter(|item| item.name == name);
        if let Some(here) = of_name().find(|item| item.file == file) {
            return Some(here);
        }
        let text = self.texts.get(file)?;
        let imports = text.split(';').filter_map(|statement| statement.rsplit_once("use ").map(|(_, path)| path));
        let word = |c: char| !c.is_alphanumeric() && c != '_';
        let import = imports.into_iter().find(|path| path.split(word).any(|part| part == name));
        let modules: Vec<&str> =
            import.unwrap_or_default().split(word).filter(|part| !matches!(*part, "" | "crate" | "super")).collect();
        let folder = file.parent().unwrap_or(file);
        let near = |item: &&Item| match import.is_some_and(|path| path.starts_with("super")) {
            true => item.file.starts_with(folder.parent().unwrap_or(folder)),
            false => modules
                .iter()
                .any(|module| item.file.with_extension("").components().any(|part| part.as_os_str() == *module)),
        };
        let all: Vec<&Item> = of_name().collect();
        match all.as_slice() {
            [] => None,
            [only] => Some(only),
            several => several.iter().copied().find(near),
        }
    }

    /// The default of a field: of its attribute, of the struct's `Default`, or of its type.
    fn default(&self, item: &Item, part: &Part) -> String {
        let text = &self.texts[&item.file];
        if let Some(of_file) = part.attributes.split("default = \"").nth(1).and_then(|rest| rest.split('"').next()) {
            let body = text.split(&format!("fn {of_file}() -> ")).nth(1).and_then(|rest| rest.split_once("{\n"));
            let value = body.and_then(|(_, rest)| rest.split("\n}").next()).unwrap_or_default();
            return self.shown(item, value.trim());
        }
        let container = item.attributes.contains("serde(default");
        // one that reads itself says so in the doc comments
        let derived = item.attributes.contains("Deserialize");
        if !container && !part.attributes.contains("default") && (derived || part.holds.starts_with("Vec<")) {
            return if part.holds.starts_with("Option<") { String::new() } else { "required".to_owned() };
        }
        let stated = text.split(&format!("impl Default for {} {{", item.name)).nth(1).filter(|_| container);
        if let Some(body) = stated.and_then(|rest| rest.split("\n}").next()) {
            let fields =
                body.rsplit("Self {").next().and_then(|rest| rest.rsplit_once('}')).map_or("", |(fields, _)| fields);
            let fields = fields.trim_end().trim_end_matches('}').replace('\n', " ");
            let wanted = format!("{}: ", part.name);
            let value = split_top(&fields).into_iter().find_map(|field| Some(field.strip_prefix(&wanted)?.to_owned()));
            let value = value.unwrap_or_else(|| panic!("{}: no default of `{}`", item.file.display(), part.name));
            return self.shown(item, &value);
        }
        match part.holds.as_str() {
            "bool" => "`false`".to_owned(),
            "f64" => "`0.0`".to_owned(),
            "usize" | "u64" | "i64" => "`0`".to_owned(),
            "String" => "`\"\"`".to_owned(),
            kind if kind.starts_with('[') => "`[0, 0]`".to_owned(),
            kind if kind.starts_with("Vec<") => "`[]`".to_owned(),
            kind => match self.find(kind, &item.file) {
                Some(of) if of.is_enum => {
                    let chosen = of.parts.iter().find(|variant| variant.attributes.contains("#[default]"));
                    format!("`\"{}\"`", snake(&chosen.unwrap_or(&of.parts[0]).name))
                }
                _ => String::new(),
            },
        }
    }

    /// A default as TOML has it; nothing for what is absent.
    fn shown(&self, item: &Item, value: &str) -> String {
        let list = |text: &str| format!("`[{}]`", text.replace(".to_owned()", ""));
        let bracketed = |open: &str| value.strip_prefix(open)?.strip_suffix(')').or(None)?.strip_suffix(']');
        if value == "None" || value == "BTreeMap::new()" || value.ends_with("::default()") {
            return String::new();
        }
        if value == "Vec::new()" {
            return "`[]`".to_owned();
        }
        if value == "String::new()" {
            return "`\"\"`".to_owned();
        }
        if let Some(text) = value.strip_suffix(".to_owned()") {
            return format!("`{text}`");
        }
        if let Some(text) = bracketed("owned(&[") {
            return list(text);
        }
        if let Some(text) = value.trim_start_matches("vec!").strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            return list(text);
        }
        if matches!(value, "true" | "false") || value.replace('_', "").parse::<f64>().is_ok() {
            return format!("`{value}`");
        }
        if let Some((_, variant)) = value.split_once("::").filter(|(_, name)| name.chars().all(char::is_alphanumeric)) {
            return format!("`\"{}\"`", snake(variant));
        }
        // `act.dim_model`: the same as in another policy
        if let Some((module, field)) = value.split_once('.') {
            let other = self
                .items
                .iter()
                .find(|other| other.name == "Config" && other.file.ends_with(format!("{module}/config.rs")));
            if let Some((other, part)) = other.and_then(|o| Some((o, o.parts.iter().find(|part| part.name == field)?)))
            {
                return self.default(other, part);
            }
        }
        panic!("{}: `{value}` is no plain default of `{}`: write a literal", item.file.display(), item.name)
    }

    /// A type in words, and what its values mean.
    fn kind(&self, kind: &str, file: &Path) -> (String, String) {
        let of = |inner: &str| self.kind(inner, file);
        if let Some(inner) = inside(kind, "Option<") {
            return of(inner);
        }
        if let Some(inner) = inside(kind, "Vec<") {
            return (format!("list of {}", of(inner).0), String::new());
        }
        if let Some((inner, count)) = kind.strip_prefix('[').and_then(|k| k.strip_suffix(']')?.split_once("; ")) {
            return (format!("{count} of {}", of(inner).0), String::new());
        }
        let word = match kind {
            "usize" | "u64" | "i64" | "u32" | "i8" => "integer",
            "f64" | "f32" => "number",
            "bool" => "bool",
            "String" => "string",
            _ => "",
        };
        if !word.is_empty() {
            return (word.to_owned(), String::new());
        }
        let Some(item) = self.find(kind, file).filter(|item| item.is_enum) else {
            return ("table".to_owned(), String::new());
        };
        let (mut names, mut meanings) = (Vec::new(), Vec::new());
        for variant in &item.parts {
            let name = match variant.fields.is_empty() {
                true => format!("`\"{}\"`", snake(&variant.name)),
                false => format!("table `{}`", snake(&variant.name)),
            };
            meanings.push(format!("{name}: {}", variant.doc.trim().trim_end_matches('.').replace('|', "\\|")));
            names.push(name);
        }
        (names.join(", "), format!(" {}.", meanings.join("; ")))
    }

    /// The table of a struct's options, and below it those of the tables in it.
    fn section(&self, page: &mut Page, heading: &str, prefix: &str, item: &Item, stated: &BTreeMap<String, String>) {
        let same = |(known, of): &&(String, String)| {
            *of == format!("{}:{}", item.file.display(), item.name) && known == prefix
        };
        if page.seen.iter().any(|seen| same(&seen)) {
            return;
        }
        page.seen.push((prefix.to_owned(), format!("{}:{}", item.file.display(), item.name)));
        let _ = writeln!(page.text, "{heading}\n\n| option | type | default | meaning |\n|---|---|---|---|");
        let mut below = Vec::new();
        for part in &item.parts {
            let mut name = format!("{prefix}{}", part.name);
            let mut inner = inside(&part.holds, "Option<").unwrap_or(&part.holds);
            if let Some(of) = inside(inner, "BTreeMap<String, ") {
                name.push_str(".NAME");
                inner = of;
            }
            assert!(!part.doc.is_empty(), "{}: `{}` has no doc comment", item.file.display(), part.name);
            let table = self.find(inner, &item.file).filter(|found| !found.is_enum);
            let (kind, meanings) = match &table {
                Some(_) => (format!("table `[{name}]`"), String::new()),
                None => self.kind(inner, &item.file),
            };
            let default = match stated.get(&name) {
                Some(value) => format!("`{value}`"),
                None => self.default(item, part),
            };
            let _ = writeln!(page.text, "| `{name}` | {kind} | {default} | {}{meanings} |", sentence(&part.doc));
            page.options += 1;
            for variant in
                self.find(inner, &item.file).filter(|found| found.is_enum).iter().flat_map(|found| &found.parts)
            {
                for field in &variant.fields {
                    let (kind, _) = self.kind(&field.holds, &item.file);
                    let name = format!("{name}.{}.{}", snake(&variant.name), field.name);
                    let _ = writeln!(page.text, "| `{name}` | {kind} | required | {} |", sentence(&field.doc));
                    page.options += 1;
                }
            }
            below.extend(table.map(|table| (name, table)));
        }
        page.text.push('\n');
        for (name, table) in below {
            self.section(page, &format!("#### `[{name}]`"), &format!("{name}."), table, stated);
        }
    }
}

#[derive(Default)]
struct Page {
    text: String,
    options: usize,
    /// tables that are written already: where, and of which struct
    seen: Vec<(String, String)>,
}

/// The page, and how many options it has.
///
/// # Panics
/// At an option without a doc comment, or a default that is no literal.
pub fn options_page() -> (String, usize) {
    let sources = Sources::read();
    let file = |path: &str| root().join("crates").join(path);
    let read = |path: &str| fs::read_to_string(root().join(path)).expect("a file of the repository");
    let base = plain_toml(&read("configs/base.toml"));
    let mut page = Page::default();
    let of = |path: &str, name: &str| {
        let file = file(path);
        sources.find(name, &file).unwrap_or_else(|| panic!("{name} in {}", file.display())).clone()
    };
    // fields that are sections, one by one
    let sections = |page: &mut Page, root: &Item, but: &[&str]| {
        let plain = |part: &&Part| part.holds == "String";
        let top = Item { parts: root.parts.iter().filter(plain).cloned().collect(), ..root.clone() };
        let stated = BTreeMap::from([
            ("description".to_owned(), "derived".to_owned()),
            ("entry".to_owned(), "derived".to_owned()),
        ]);
        sources.section(page, "### Name and description", "", &top, &stated);
        for part in root.parts.iter().filter(|part| !plain(part) && !but.contains(&part.name.as_str())) {
            let kind = inside(&part.holds, "Option<").unwrap_or(&part.holds);
            let Some(item) = sources.find(kind, &root.file) else { panic!("{kind} is defined somewhere") };
            sources.section(page, &format!("### `[{}]`", part.name), &format!("{}.", part.name), item, &base);
        }
    };
    page.text.push_str("## Experiments on robot tasks\n\n");
    sections(&mut page, &of("zoo/src/experiment.rs", "Experiment"), &["policy"]);
    let registry = &sources.texts[&file("models/src/registry.rs")];
    let mut doc = "";
    for line in registry.lines() {
        doc = line.strip_prefix("    /// ").unwrap_or(doc);
        let Some((name, rest)) = line.strip_prefix("    \"").and_then(|rest| rest.split_once("\" => ")) else {
            continue;
        };
        let Some(module) = rest.split_once(": ").and_then(|(_, path)| path.split("::").next()) else { continue };
        let places = [format!("{module}/config.rs"), format!("{module}.rs"), "floors/mod.rs".to_owned()];
        let config = places.iter().find_map(|place| {
            sources.items.iter().find(|item| {
                let ours = ["src/models", "floors"].map(|folder| item.file.ends_with(format!("{folder}/{place}")));
                item.name == "Config" && ours.contains(&true)
            })
        });
        let config = config.unwrap_or_else(|| panic!("the options of `{name}`"));
        let stated = policy_file(name);
        let others: Vec<String> =
            stated.iter().filter(|(key, _)| is_setting(key)).map(|(k, v)| format!("`{k}={v}`")).collect();
        let others = match others.is_empty() {
            true => String::new(),
            false => format!(" `configs/policy/{name}.toml` also sets {}.", others.join(", ")),
        };
        // every policy has a table of its own, also where two share a struct
        page.seen.retain(|(prefix, _)| prefix != "policy.");
        let heading = format!("### `[policy]` with `type = \"{name}\"`\n\n{}{others}", sentence(doc));
        sources.section(&mut page, &heading, "policy.", config, &stated);
    }
    page.text.push_str("## Experiments on puzzles\n\n`[train]` is that of robot tasks.\n\n");
    let puzzle = of("study/src/puzzle/experiment.rs", "PuzzleExperiment");
    page.seen.retain(|(prefix, _)| prefix == "train.");
    sections(&mut page, &puzzle, &["model", "train"]);
    for variant in &of("study/src/puzzle/model.rs", "SolverConfig").parts {
        let config = variant.holds.trim_matches(['(', ')']);
        let config = sources.find(config, &file("study/src/puzzle/model.rs")).unwrap_or_else(|| panic!("{config}"));
        let heading = format!("### `[model]` with `type = \"{}\"`\n\n{}", snake(&variant.name), sentence(&variant.doc));
        page.seen.retain(|(prefix, _)| prefix != "model.");
        sources.section(&mut page, &heading, "model.", config, &BTreeMap::new());
    }
    let head = format!(
        "# Options of an experiment\n\nAll {} options, generated from the code by `make reference`. Set any of them on the command line, \
         `actrm-zoo train act_lift train.steps=1000`, or in a file ([experiments](../howto/experiments.md)). The default is the program's, or \
         that of `configs/base.toml` and the policy's file; tasks have settings of their own. \
         `actrm-zoo train act_lift --print-config` prints what an experiment really uses. An empty default means: not set.\n\n",
        page.options
    );
    (format!("{head}{}\n", page.text.trim_end()), page.options)
}
