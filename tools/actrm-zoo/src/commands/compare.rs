use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

use anyhow::{Context, bail};
use audit::{KnownEntries, audit};
use cli::{INTERRUPTED, Stop, limits, shown};
use report::comparison::{ALPHA, Comparison, Flips, compare, compare_progress};
use report::statistics::{Difference, Estimate};
use report::{LeaderboardRow, Reading, rank};
use rollout::Pool;
use serde_json::{Value, json};
use zoo::entry::{EntryId, LoadedEntry};
use zoo::evaluation::{Environment, EvaluationOptions, FIRST_SEED, Subject};
use zoo::results::{EvaluationRecord, Seeds, StoredEvaluation};

use crate::compared::{self, Compared, Side, counts, flips_json, list, p_text, sequential_text};
use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs, entry_names};
use crate::simulation::{RunArgs, environment, limited_worker, run_missing, start};

const GOES_ON: &str = "stopped; run the same command again to resume";

/// Compare two entries, or two families, on the seeds that both were evaluated on
///
/// The comparison counts the seeds on which only one of the two succeeded. It reports the difference in success with its
/// interval, McNemar's exact test, and a sequential test that is valid however often one looks. `--until-decided` runs episodes
/// of both until the sequential test is significant at 5% or --max-episodes is reached. Results must be valid, as for
/// `actrm-zoo leaderboard`. An entry can be compared with itself where it was evaluated in several ways, for example with two
/// versions of the simulator.
///
/// A side can be a file that another program wrote: LeRobot's `eval_info.json`, a result file of vla-eval, or a CSV with the
/// columns task, policy, success, and seed or episode. Equal seeds are paired; otherwise the tests are Barnard's and, in the
/// order of the episodes, N-SCORE and SAVI. Such results have no seal and are not ranked.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo compare lift-act-s1 lift-actrm-s1
  actrm-zoo compare 'lift-act-s*' 'lift-actrm-s*'
  actrm-zoo compare stack-act-s1 stack-actrm-s1 --until-decided --max-episodes 500
  actrm-zoo compare lift-act lift-act --json
  actrm-zoo compare lift-act outputs/eval_info.json --task Lift
  actrm-zoo compare results.csv:mine results.csv:theirs")]
pub struct Args {
    /// First entry: `name` (its newest version), `name@version`, or a pattern with `*` for the trainings of a family; or a
    /// file of results, `FILE` or `FILE:POLICY`
    #[arg(add = entry_names())]
    first: String,
    /// Second entry, family or file, named like the first
    #[arg(add = entry_names())]
    second: String,
    /// Run episodes of both on equal seeds until the difference is significant
    #[arg(long)]
    until_decided: bool,
    /// Stop `--until-decided` after this number of episodes per entry
    #[arg(long = "max-episodes", alias = "most", value_name = "N", default_value_t = 1000, requires = "until_decided",
        value_parser = clap::value_parser!(u64).range(20..=limits::MOST_EPISODES))]
    most: u64,
    /// First seed that `--until-decided` uses
    #[arg(long, value_name = "SEED", default_value_t = FIRST_SEED, requires = "until_decided")]
    seed_start: u64,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let (false, Some(option)) = (args.until_decided, args.run.given()) {
        bail!("{option}: expected --until-decided beside it; otherwise no episodes are run");
    }
    let registry = args.zoo.registry();
    let files = [&args.first, &args.second].map(|side| compared::is_file(side));
    if files.contains(&true) {
        return with_files(args, files);
    }
    let sides = [registry.matching(&args.first)?, registry.matching(&args.second)?];
    if args.until_decided {
        return until_decided(args, &sides);
    }
    let [first, second] = rows(args, [&sides[0], &sides[1]])?;
    let found = pairs(&first, &second, sides[0] == sides[1]);
    if found.is_empty() {
        bail!("{}", nothing(args, &sides, [&first, &second]));
    }
    let told: Vec<Told> = found.iter().map(|(one, two)| Told::of(one, two)).collect();
    match args.json {
        true => cli::print_json(&told.iter().map(Told::json).collect::<Vec<_>>())?,
        false => cli::print(&told.iter().map(Told::text).collect::<Vec<_>>().join("\n"))?,
    }
    Ok(ExitCode::SUCCESS)
}

/// The sealed rows of two lists of entries.
fn rows(args: &Args, sides: [&[EntryId]; 2]) -> anyhow::Result<[Vec<LeaderboardRow>; 2]> {
    let entries = KnownEntries::open(&args.zoo.registry())?;
    let audit = audit(&args.results.folder(&args.zoo), &entries)?;
    for left in &audit.left_out {
        cli::note(&format!("note: left out: {}: {}", shown(&left.folder), left.reason));
    }
    let reading = Reading::of(&entries, args.protocols.protocols()?);
    Ok(sides.map(|ids| {
        let of = |one: &&StoredEvaluation| {
            ids.iter().any(|id| id.name == one.record.entry.name && id.version == one.record.entry.version)
        };
        let own: Vec<StoredEvaluation> = audit.standing.iter().filter(of).cloned().collect();
        let mut rows = rank(&own, &reading);
        if let Some(task) = &args.run.task {
            rows.retain(|row| row.task() == task);
        }
        rows
    }))
}

/// Compares where a side is a file.
fn with_files(args: &Args, files: [bool; 2]) -> anyhow::Result<ExitCode> {
    if args.until_decided {
        bail!("--until-decided: expected two entries, found a file of results");
    }
    let registry = args.zoo.registry();
    let side = |text: &str, is_file: bool| -> anyhow::Result<Vec<Side>> {
        if is_file {
            return Side::of_file(text);
        }
        let ids = registry.matching(text)?;
        let [rows, _] = rows(args, [&ids, &[]])?;
        if rows.is_empty() {
            bail!("{text}: {}", none(args));
        }
        rows.iter().map(Side::of_row).collect()
    };
    let (first, second) = (side(&args.first, files[0])?, side(&args.second, files[1])?);
    let found = compared::matched(first, second, args.run.task.as_deref())?;
    match args.json {
        true => cli::print_json(&found.iter().map(Compared::json).collect::<Vec<_>>())?,
        false => cli::print(&found.iter().map(Compared::text).collect::<Vec<_>>().join("\n"))?,
    }
    Ok(ExitCode::SUCCESS)
}

/// That a side has no evaluations, of the asked task if there is one.
fn none(args: &Args) -> String {
    let of = args.run.task.as_ref().map(|task| format!(" of {task}")).unwrap_or_default();
    format!("no evaluations{of} in {}; make some with: actrm-zoo eval", shown(&args.results.folder(&args.zoo)))
}

/// Why no two rows of both sides can be compared.
fn nothing(args: &Args, sides: &[Vec<EntryId>; 2], rows: [&[LeaderboardRow]; 2]) -> String {
    let ids = |ids: &[EntryId]| ids.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let (one, two) = (ids(&sides[0]), ids(&sides[1]));
    if let Some((_, side)) = rows.iter().zip([&one, &two]).find(|(rows, _)| rows.is_empty()) {
        return format!("{side}: {}", none(args));
    }
    let results = shown(&args.results.folder(&args.zoo));
    if sides[0] == sides[1] {
        let how = "evaluate it in another way, such as with --n-action-steps, or name another entry";
        return format!(
            "{one}: both names are the same entry, and no seed was run in two ways under the same protocol in {results}; {how}"
        );
    }
    if rows[0].iter().any(|row| rows[1].iter().any(|other| is_same(row, other))) {
        return format!(
            "{one} and {two}: both have the same evaluations in {results}, and no others under the same protocol"
        );
    }
    let tasks = rows.map(|rows| rows.iter().map(LeaderboardRow::task).collect::<BTreeSet<_>>());
    if tasks[0].is_disjoint(&tasks[1]) {
        let [first, second] = tasks.map(|tasks| Vec::from_iter(tasks).join(", "));
        return format!(
            "{one} and {two}: no evaluations in {results} under the same protocol: the tasks differ, {first} and {second}"
        );
    }
    format!("{one} and {two}: no evaluations in {results} under the same protocol; make some with: actrm-zoo eval")
}

/// Whether both rows are of the same evaluations.
fn is_same(one: &LeaderboardRow, two: &LeaderboardRow) -> bool {
    one.evaluations().map(|of| &of.folder).eq(two.evaluations().map(|of| &of.folder))
}

/// Rows of both sides under the same rules; those that share seeds, if there are any.
fn pairs<'a>(
    first: &'a [LeaderboardRow],
    second: &'a [LeaderboardRow],
    same: bool,
) -> Vec<(&'a LeaderboardRow, &'a LeaderboardRow)> {
    let mut all: Vec<(&LeaderboardRow, &LeaderboardRow)> = Vec::new();
    for one in first {
        for two in second.iter().filter(|two| one.record().protocol == two.record().protocol) {
            // where both sides have an entry: each pair once, and no row beside itself
            let before = all.iter().any(|(a, b)| is_same(a, two) && is_same(b, one));
            if !is_same(one, two) && !before {
                all.push((one, two));
            }
        }
    }
    let shares = |(one, two): &(&LeaderboardRow, &LeaderboardRow)| one.record().seeds.overlap(&two.record().seeds);
    if same || all.iter().any(shares) {
        all.retain(shares);
    }
    all
}

/// What is said of two rows.
struct Told<'a> {
    rows: [&'a LeaderboardRow; 2],
    comparison: Comparison,
    /// How much further the first comes on its way, where episodes say it.
    progress: Option<Difference>,
    /// Of two single trainings that share seeds.
    flips: Option<Flips>,
}

impl<'a> Told<'a> {
    fn of(first: &'a LeaderboardRow, second: &'a LeaderboardRow) -> Self {
        let single = first.n_trainings() == 1 && second.n_trainings() == 1;
        let comparison = compare(first, second);
        let flips = (single && comparison.shared > 0).then(|| Flips::of(&outcomes(first), &outcomes(second)));
        let progress = compare_progress(first, second);
        Self { rows: [first, second], comparison, progress, flips }
    }

    /// What tells the two apart: their names, or else how they were run.
    fn names(&self) -> [String; 2] {
        let [one, two] = self.rows;
        if one.name() != two.name() {
            return [one.name(), two.name()];
        }
        let differing = |row: &LeaderboardRow, other: &LeaderboardRow| {
            let (mine, theirs) = (row.record(), other.record());
            let mut parts: Vec<String> = mine
                .versions
                .iter()
                .filter(|(name, version)| theirs.versions.get(*name) != Some(*version))
                .map(|(name, version)| format!("{name} {version}"))
                .collect();
            if mine.changed_sources() != theirs.changed_sources() {
                parts.extend(mine.changed_sources().iter().map(|(name, sum)| format!("{name} sources {sum}")));
            }
            if mine.execution != theirs.execution {
                parts.push(row.execution_text());
            }
            if mine.seeds != theirs.seeds {
                parts.push(format!("seeds {}", mine.seeds));
            }
            format!("{} ({})", row.name(), parts.join(", "))
        };
        [differing(one, two), differing(two, one)]
    }

    fn text(&self) -> String {
        let Self { rows: [one, two], comparison, progress, flips } = self;
        let [first, second] = self.names();
        // under other simulators the rules alone are what both have
        let alike = one.protocol_text() == two.protocol_text();
        let rules = if alike { one.protocol_text() } else { one.record().protocol.id() };
        let mut text = format!("{}, {rules}: {} seeds that both were run on\n", one.task(), comparison.shared);
        let width = first.chars().count().max(second.chars().count());
        for (name, row) in [(&first, one), (&second, two)] {
            let trainings = match row.n_trainings() {
                1 => String::new(),
                n => format!(", {n} trainings"),
            };
            text.push_str(&format!("  {name:width$}  {}{trainings}\n", counts(row.counts)));
        }
        let points = |x: f64| format!("{:+.1}", x * 1e2);
        let interval =
            comparison.interval.map_or(String::new(), |(low, high)| format!(" [{}, {}]", points(low), points(high)));
        text.push_str(&format!(
            "  difference {} points{interval}, {} p {}\n",
            points(comparison.difference),
            comparison.test.name(),
            p_text(comparison.p_value)
        ));
        if let (Some(found), [Some(one), Some(two)]) = (progress, [one, two].map(|row| row.progress)) {
            let share = |x: f64| format!("{:.1}%", x * 1e2);
            let Estimate { value, low, high } = found.estimate;
            text.push_str(&format!(
                "  mean progress {} and {}, difference {} points [{}, {}], p {}\n",
                share(one.value),
                share(two.value),
                points(value),
                points(low),
                points(high),
                p_text(found.p_value)
            ));
        }
        let Some(flips) = flips else { return text };
        text.push_str(&format!(
            "  both {}, only {first} {}, only {second} {}, neither {}\n",
            flips.counts.both, flips.counts.first_only, flips.counts.second_only, flips.counts.neither
        ));
        text.push_str(&format!("  {}\n", sequential_text(flips, &first, &second)));
        for (name, seeds) in [(&first, &flips.first_only), (&second, &flips.second_only)] {
            if !seeds.is_empty() {
                text.push_str(&format!("  only {name}: {}\n", list(seeds)));
            }
        }
        text
    }

    fn json(&self) -> Value {
        let Self { rows: [one, two], comparison, progress, flips } = self;
        let side = |row: &LeaderboardRow, name: &str| {
            json!({
                "name": name, "trainings": row.n_trainings(), "successes": row.counts.successes,
                "episodes": row.counts.episodes, "execution": row.execution_text(), "versions": row.record().versions,
                "seeds": row.seeds_text(), "progress": row.progress.map(|progress| progress.value),
            })
        };
        let [first, second] = self.names();
        let mut value = json!({
            "task": one.task(), "protocol": one.record().protocol.id(), "first": side(one, &first),
            "second": side(two, &second), "shared_seeds": comparison.shared, "difference": comparison.difference,
            "ci95": comparison.interval.map(|(low, high)| [low, high]), "test": comparison.test.name(),
            "p_value": comparison.p_value,
        });
        if let Some(found) = progress {
            let Estimate { value: difference, low, high } = found.estimate;
            value["progress"] = json!({"difference": difference, "ci95": [low, high], "p_value": found.p_value});
        }
        if let Some(flips) = flips {
            value["flips"] = flips_json(flips);
        }
        value
    }
}

/// Successes of the only training by seed.
fn outcomes(row: &LeaderboardRow) -> BTreeMap<u64, bool> {
    row.evaluations().flat_map(|one| &one.episodes).map(|episode| (episode.seed, episode.success)).collect()
}

/// One of the two entries that are run.
struct Running {
    subject: Subject<'static>,
    /// Outcomes of the first seeds without a gap, ascending.
    outcomes: BTreeMap<u64, bool>,
}

impl Running {
    fn new(subject: Subject<'static>) -> Self {
        Self { subject, outcomes: BTreeMap::new() }
    }

    /// Takes in what stands under `results` of evaluations that differ in nothing but their seeds, from `start` on.
    fn take_stored(
        &mut self,
        ready: &rollout::Ready,
        standing: &[StoredEvaluation],
        options: &EvaluationOptions,
    ) -> anyhow::Result<()> {
        let own = self.subject.record(ready, options)?;
        let alike = |record: &EvaluationRecord| {
            EvaluationRecord { seeds: own.seeds, shard: own.shard, demonstrated: own.demonstrated, ..record.clone() }
                .is_same(&own)
        };
        let all: BTreeMap<u64, bool> = standing
            .iter()
            .filter(|one| alike(&one.record))
            .flat_map(|one| &one.episodes)
            .map(|episode| (episode.seed, episode.success))
            .collect();
        let without_gap =
            (options.seeds.start..).zip(all.range(options.seeds.start..)).take_while(|(k, (seed, _))| k == *seed);
        self.outcomes = without_gap.map(|(_, (seed, success))| (*seed, *success)).collect();
        Ok(())
    }
}

/// Runs both until the sequential test decides, or the most episodes are run.
fn until_decided(args: &Args, sides: &[Vec<EntryId>; 2]) -> anyhow::Result<ExitCode> {
    let [[first], [second]] = [sides[0].as_slice(), sides[1].as_slice()] else {
        bail!("--until-decided: expected one entry on either side, found {} and {}", sides[0].len(), sides[1].len());
    };
    if first == second {
        bail!("--until-decided: expected two entries, found {first} twice");
    }
    limits::check_seeds(args.seed_start, args.most)?;
    let registry = args.zoo.registry();
    let results = args.results.folder(&args.zoo);
    let standing = audit(&results, &KnownEntries::open(&registry)?)?.standing;
    let stop = Stop::install(GOES_ON)?;
    let loaded = [first, second].map(|id| -> anyhow::Result<LoadedEntry> {
        registry.entry(&id.to_string()).and_then(|entry| entry.load()).with_context(|| format!("entry {id}"))
    });
    let [one, two] = loaded;
    let loaded = [one?, two?];
    let mut pools: Vec<Pool> = Vec::new();
    let mut keys: Vec<Environment> = Vec::new();
    let mut of_pool = Vec::new();
    for entry in &loaded {
        let key = environment(&args.run, entry.entry().meta())?;
        if !keys.contains(&key) {
            let spec = limited_worker(&key, &args.run, args.run.control)?;
            let Some(pool) = start(&args.run, spec, &stop)? else {
                return Ok(interrupted(pools));
            };
            pools.push(pool);
            keys.push(key.clone());
        }
        of_pool.push(keys.iter().position(|known| *known == key).unwrap_or_default());
    }
    let options = |count: u64, side: usize| EvaluationOptions {
        seeds: Seeds { start: args.seed_start, count },
        shard: None,
        env_module: keys[of_pool[side]].env_module.clone(),
        force: args.run.force,
    };
    let mut both = Vec::new();
    for (k, entry) in loaded.iter().enumerate() {
        let mut subject = entry.subject();
        if let Some(max_steps) = args.run.max_steps {
            subject.max_steps = Some(usize::try_from(max_steps)?);
        }
        if subject.time_decides {
            bail!(
                "entry {}: it has a time budget, so its episodes may end differently and cannot be compared",
                subject.entry
            );
        }
        let mut side = Running::new(subject);
        side.take_stored(pools[of_pool[k]].ready(), &standing, &options(args.most, k))?;
        both.push(side);
    }
    let records = [0, 1].map(|k| both[k].subject.record(pools[of_pool[k]].ready(), &options(args.most, k)));
    let [a, b] = records;
    let (a, b) = (a?, b?);
    if a.protocol != b.protocol {
        bail!(
            "{first} and {second}: protocol: expected the same, found {} and {} (--max-steps makes caps equal)",
            a.protocol.id(),
            b.protocol.id()
        );
    }
    let mut run = both.iter().map(|side| side.outcomes.len() as u64).min().unwrap_or_default().min(args.most);
    loop {
        let upto = |side: &Running| side.outcomes.range(..args.seed_start + run).map(|(s, o)| (*s, *o)).collect();
        let flips = Flips::of(&upto(&both[0]), &upto(&both[1]));
        let names = [first.to_string(), second.to_string()];
        let told = format!(
            "{run} seeds: only {first} {}, only {second} {}",
            flips.counts.first_only, flips.counts.second_only
        );
        if flips.decided_after.is_some() || run >= args.most {
            let text = format!("{told}; {}\n", sequential_text(&flips, &names[0], &names[1]));
            match args.json {
                true => cli::print_json(&json!({
                    "first": names[0], "second": names[1], "protocol": a.protocol.id(), "seeds": run, "level": ALPHA,
                    "flips": flips_json(&flips),
                }))?,
                false => cli::print(&text)?,
            }
            pools.into_iter().for_each(cli::close);
            return Ok(ExitCode::SUCCESS);
        }
        if run > 0 {
            cli::note(&format!("{told}; not decided (p {} at any time)", p_text(flips.sequential.p_value())));
        }
        // half as many again: few results are left on the way, and the last one holds the others
        run = (run + run / 2).max(20).min(args.most);
        for (k, side) in both.iter_mut().enumerate() {
            let done = run_missing(&side.subject, &mut pools[of_pool[k]], &results, &options(run, k))?;
            let Some(done) = done.filter(|_| !stop.asked()) else { return Ok(interrupted(pools)) };
            side.outcomes = done.evaluation.episodes.iter().map(|episode| (episode.seed, episode.success)).collect();
        }
    }
}

fn interrupted(pools: Vec<Pool>) -> ExitCode {
    pools.into_iter().for_each(cli::close);
    cli::note(GOES_ON);
    ExitCode::from(INTERRUPTED)
}
