use crate::svg::{self, Content};
use crate::view;
use anyhow::{Context, Result, bail};
use dataset::{Dataset, EpisodeMeta, Picture};
use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Plot an episode and the whole set, dimension by dimension, or the images of an episode.
///
/// Each row is one dimension: on the left its curve over the episode, on the right its histogram over all frames of the set. The
/// file extension decides the format: .svg is one chart, .html a page with one chart per column. Neither needs a network. A .png
/// file shows camera images, one row per camera, from the first frame to the last. Depth is grey, the nearest point white.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data plot lift --out lift.html
  actrm-data plot lift --episode 3 --column action --out actions.svg
  actrm-data plot lift_image --episode 3 --frames 12 --out episode.png")]
pub struct Args {
    /// Data set directory
    dir: PathBuf,
    /// Episode to plot
    #[arg(long, default_value_t = 0)]
    episode: usize,
    /// Column or camera to plot, by name; may be repeated [default: all numeric columns; of a .png file all cameras]
    #[arg(long, value_name = "NAME")]
    column: Vec<String>,
    /// Number of frames of a .png file, evenly spread
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..=1000))]
    frames: u16,
    /// File to create: .svg, .html or .png
    #[arg(long, short)]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let extension = args.out.extension().and_then(|e| e.to_str()).unwrap_or_default();
    if !matches!(extension, "svg" | "html" | "png") {
        bail!("{}: expected a name ending in .svg, .html or .png", args.out.display());
    }
    let set = Dataset::open(&args.dir)?;
    let Some(episode) = set.episodes().get(args.episode) else {
        bail!("{}: no episode {}; there are {}", args.dir.display(), args.episode, set.episodes().len());
    };
    let pictures = extension == "png";
    let all: Vec<&str> = match pictures {
        true => set.cameras().chain(set.depth_names()).collect(),
        false => set.column_names().collect(),
    };
    if pictures && all.is_empty() {
        bail!("{}: no images in it", args.dir.display());
    }
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
    let file = match extension {
        "png" => contact_sheet(&set, episode, &chosen, usize::from(args.frames))?,
        "svg" => {
            let data: Vec<Dimension> = chosen.iter().flat_map(|name| dimensions(&set, episode, name)).collect();
            svg::page(&heading, &charts(&data), 2).into_bytes()
        }
        _ => page(&set, episode, &chosen, &heading).into_bytes(),
    };
    cli::refuse_existing(&args.out)?;
    write(&args.out, &file)?;
    cli::print(&format!("{}: {}\n", args.out.display(), heading))?;
    Ok(ExitCode::SUCCESS)
}

/// A row a camera, `most` frames from the first to the last, as a PNG file.
fn contact_sheet(set: &Dataset, episode: &EpisodeMeta, cameras: &[&str], most: usize) -> Result<Vec<u8>> {
    let count = most.min(episode.length);
    let frames: Vec<usize> = (0..count).map(|i| i * (episode.length - 1) / (count - 1).max(1)).collect();
    let row = |camera: &&str| -> Result<Vec<Picture>> { view::pictures(set, camera, episode.index, &frames) };
    let rows = cameras.iter().map(row).collect::<Result<Vec<_>>>()?;
    Ok(Picture::sheet(&rows, 4).to_png()?)
}

/// One dimension of a column.
struct Dimension {
    name: String,
    course: Vec<f32>,
    all: Vec<f32>,
}

fn dimensions(set: &Dataset, episode: &EpisodeMeta, name: &str) -> Vec<Dimension> {
    let Some(column) = set.column(name) else { return Vec::new() };
    let names = set.names(name);
    (0..column.dim)
        .map(|d| {
            let all: Vec<f32> = column.data.iter().skip(d).step_by(column.dim).copied().collect();
            Dimension {
                name: match (column.dim, names.get(d)) {
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

/// Writes a file under a temporary name first. A file of that name is replaced.
pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let _parents = cli::make_parent(path)?;
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".partial-{}", std::process::id()));
    let temporary = parent.join(name);
    let write = || -> std::io::Result<()> {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    };
    write()
        .inspect_err(|_| drop(std::fs::remove_file(&temporary)))
        .with_context(|| format!("{}: cannot write it", path.display()))
}
