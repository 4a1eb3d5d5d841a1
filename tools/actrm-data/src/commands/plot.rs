use crate::svg::{self, Content};
use anyhow::{Context, Result, bail};
use dataset::{Dataset, EpisodeMeta};
use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Draw an episode and the whole set, dimension by dimension.
///
/// One row a dimension: on the left its course over the episode, on the right its histogram over all frames of the
/// set. The file's ending decides: .svg is one picture, .html a page with one picture a column. Neither needs anything
/// from the network.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data plot lift --out lift.html
  actrm-data plot lift --episode 3 --column action --out actions.svg")]
pub struct Args {
    /// Data set directory
    dir: PathBuf,
    /// Episode to draw
    #[arg(long, default_value_t = 0)]
    episode: usize,
    /// Columns to draw, by name; may be repeated [default: actions, observations and rewards]
    #[arg(long, value_name = "NAME")]
    column: Vec<String>,
    /// File to create, .svg or .html
    #[arg(long)]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let extension = args.out.extension().and_then(|e| e.to_str()).unwrap_or_default();
    if !matches!(extension, "svg" | "html") {
        bail!("{}: expected a name ending in .svg or .html", args.out.display());
    }
    let set = Dataset::open(&args.dir)?;
    let Some(episode) = set.episodes().get(args.episode) else {
        bail!("{}: no episode {}; there are {}", args.dir.display(), args.episode, set.episodes().len());
    };
    let all: Vec<&str> = set.column_names().collect();
    for name in &args.column {
        if !all.contains(&name.as_str()) {
            bail!("{}: no column {name}; there is {}", args.dir.display(), all.join(", "));
        }
    }
    let chosen: Vec<&str> =
        all.into_iter().filter(|name| args.column.is_empty() || args.column.iter().any(|c| c == name)).collect();
    let heading = format!(
        "{}: episode {}{}, {} steps",
        set.env().map_or("data set", |e| e.env_name.as_str()),
        episode.index,
        episode.demo.as_ref().map_or_else(String::new, |d| format!(" ({d})")),
        episode.length
    );
    let text = match extension {
        "svg" => {
            let data: Vec<Dimension> = chosen.iter().flat_map(|name| dimensions(&set, episode, name)).collect();
            svg::page(&heading, &charts(&data), 2)
        }
        _ => page(&set, episode, &chosen, &heading),
    };
    create(&args.out, &text)?;
    cli::print(&format!("{}: {}\n", args.out.display(), heading))?;
    Ok(ExitCode::SUCCESS)
}

/// One dimension of a column.
struct Dimension {
    name: String,
    course: Vec<f32>,
    all: Vec<f32>,
}

fn dimensions(set: &Dataset, episode: &EpisodeMeta, name: &str) -> Vec<Dimension> {
    let Some(column) = set.column(name) else { return Vec::new() };
    let names = set.info().features.get(name).map(|f| f.names.clone()).unwrap_or_default();
    (0..column.dim)
        .map(|d| {
            let all: Vec<f32> = column.data.iter().skip(d).step_by(column.dim).copied().collect();
            let own = names.get(d).and_then(|n| n.as_str());
            Dimension {
                name: match (column.dim, own) {
                    (1, _) => name.to_owned(),
                    (_, Some(own)) => format!("{name}: {own}"),
                    (_, None) => format!("{name}[{d}]"),
                },
                course: all[episode.from..episode.to].to_vec(),
                all,
            }
        })
        .collect()
}

fn charts(dimensions: &[Dimension]) -> Vec<(String, Content<'_>)> {
    let both = dimensions.iter().flat_map(|d| {
        [(d.name.clone(), Content::Line(&d.course)), (format!("{}, all frames", d.name), Content::Histogram(&d.all))]
    });
    both.collect()
}

fn page(set: &Dataset, episode: &EpisodeMeta, columns: &[&str], heading: &str) -> String {
    let title = svg::escape(heading);
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n<title>{title}</title>\n<body style=\"font-family:sans-serif\">\n<h1>{title}</h1>\n"
    );
    for name in columns {
        let data = dimensions(set, episode, name);
        out.push_str(&svg::page(name, &charts(&data), 2));
    }
    out.push_str("</body>\n</html>\n");
    out
}

/// Writes a new file under a temporary name first.
fn create(path: &Path, text: &str) -> Result<()> {
    if path.exists() {
        bail!("{}: exists already; choose another path or remove it first", path.display());
    }
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".partial-{}", std::process::id()));
    let temporary = parent.join(name);
    let write = || -> std::io::Result<()> {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    };
    write()
        .inspect_err(|_| drop(std::fs::remove_file(&temporary)))
        .with_context(|| format!("{}: cannot write it", path.display()))
}
