//! Evaluations to rows: families joined, ranked inside their task and protocol, compared with each other.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};

use audit::KnownEntries;
use zoo::entry::{EntryId, Families};
use zoo::protocols::Protocols;
use zoo::results::{EntryIdentity, StoredEvaluation};

use super::row::LeaderboardRow;
use crate::comparison::standings;

/// How evaluations are read: which entries are trainings of one family, what they see, and which protocols have names.
#[derive(Debug, Clone, Default)]
pub struct Reading {
    /// The families of the zoo's entries.
    pub families: Families,
    /// The cameras of those that see pictures.
    pub cameras: BTreeMap<EntryId, Vec<String>>,
    /// Named protocols.
    pub protocols: Protocols,
}

impl Reading {
    /// As `entries` and `protocols` say.
    pub fn of(entries: &KnownEntries, protocols: Protocols) -> Self {
        let cameras = entries.good().map(|entry| (entry.id(), entry.meta().camera_names()));
        let cameras = cameras.filter(|(_, names)| !names.is_empty()).collect();
        Self { families: entries.families(), cameras, protocols }
    }

    fn cameras_of(&self, entry: &EntryIdentity) -> Vec<String> {
        let id = EntryId { name: entry.name.clone(), version: entry.version };
        self.cameras.get(&id).cloned().unwrap_or_default()
    }
}

/// The rows of all whole evaluations (shards wait until they are merged), best first in each task and protocol.
///
/// Evaluations of one family under the same protocol on the same seeds are one row. A row whose seeds and trainings are all
/// in another one is left out, unless they are the block of a named protocol.
pub fn rank(evaluations: &[StoredEvaluation], reading: &Reading) -> Vec<LeaderboardRow> {
    let mut rows = without_parts(joined(evaluations, reading));
    name_simulators(&mut rows);
    tell_apart(&mut rows);
    // a group's name holds a hash: made once a row, not at every comparison
    let mut grouped: Vec<_> = rows.into_iter().map(|row| (group(&row), row)).collect();
    grouped.sort_by(|(one_group, one), (two_group, two)| one_group.cmp(two_group).then_with(|| order(one, two)));
    let mut rows: Vec<LeaderboardRow> = grouped.into_iter().map(|(_, row)| row).collect();
    let (mut place, mut last) = (0, None);
    for at in 0..rows.len() {
        if rows[at].too_few() || rows[at].bound().is_some() {
            // takes no place
            continue;
        }
        let before = last.map(|at: usize| &rows[at]).filter(|before| group(before) == group(&rows[at]));
        place = before.map_or(1, |_| place + 1);
        let same = before.filter(|before| before.counts == rows[at].counts).and_then(|before| before.rank);
        rows[at].rank = Some(same.unwrap_or(place));
        last = Some(at);
    }
    compare_all(&mut rows);
    rows
}

/// Rows that are ranked against each other agree in this: what they were asked, and whether they see pictures. Who is told
/// where everything stands has no part in the place of who must see it.
pub(crate) type Group = (Asked, bool);

/// Task, the named block of seeds, and rules with the simulator that plays by them.
pub(crate) type Asked = (String, String, String);

/// What a row is ranked in.
pub(crate) fn group(row: &LeaderboardRow) -> Group {
    (asked(row), row.sees_pictures())
}

/// What a row was asked.
pub(crate) fn asked(row: &LeaderboardRow) -> Asked {
    let block = row.named.as_ref().map_or(String::new(), |(name, block)| format!("{name} {block}"));
    let simulator: Vec<String> = simulator(row).map(|(name, version)| format!("{name} {version}")).collect();
    (row.task().to_owned(), block, format!("{} {}", row.record().protocol.id(), simulator.join(" ")))
}

/// Versions of what moves the world, with the sources' sum where they are not those of the release. Python and its arrays
/// only carry it: `eval --again` says where they differ.
fn simulator(row: &LeaderboardRow) -> impl Iterator<Item = (String, String)> {
    let mut changed = row.record().changed_sources();
    let mut all: BTreeMap<String, String> = BTreeMap::new();
    for (name, version) in
        row.record().versions.iter().filter(|(name, _)| !["python", "numpy"].contains(&name.as_str()))
    {
        let sources = changed.remove(name.as_str()).map_or(String::new(), |sum| format!(" (sources {sum})"));
        all.insert(name.clone(), format!("{version}{sources}"));
    }
    all.extend(changed.into_iter().map(|(name, sum)| (name.to_owned(), format!("(sources {sum})"))));
    all.into_iter()
}

/// Lets rows of the same rules say the versions of the simulator in which they differ from others.
fn name_simulators(rows: &mut [LeaderboardRow]) {
    type Found = BTreeMap<String, BTreeSet<String>>;
    let mut found: BTreeMap<String, Found> = BTreeMap::new();
    for row in rows.iter() {
        let rules = found.entry(row.record().protocol.id()).or_default();
        for (name, version) in simulator(row) {
            rules.entry(name).or_default().insert(version);
        }
    }
    for row in rows {
        let rules = &found[&row.record().protocol.id()];
        // one that only some have tells them apart, too
        let everywhere =
            |name: &str| rules[name].len() == 1 && !rules[name].iter().any(|text| text.contains("(sources"));
        let differing = simulator(row).filter(|(name, _)| !everywhere(name));
        let texts: Vec<String> = differing.map(|(name, version)| format!("{name} {version}")).collect();
        row.simulator = texts.join(", ");
    }
}

/// Lets rows of one entry under the same protocol say in what they differ: their seeds, how chunks are executed, what drew
/// their pictures, the sources of what simulated.
fn tell_apart(rows: &mut [LeaderboardRow]) {
    type Differing = (BTreeSet<String>, BTreeSet<String>, BTreeSet<String>, BTreeSet<String>);
    let key = |row: &LeaderboardRow| (row.name(), row.protocol_text());
    let mut found: BTreeMap<(String, String), Differing> = BTreeMap::new();
    for row in rows.iter() {
        let (seeds, executions, renderers, sources) = found.entry(key(row)).or_default();
        seeds.insert(row.record().seeds.to_string());
        executions.insert(row.execution_text());
        renderers.insert(row.renderer_text());
        sources.insert(row.sources_text());
    }
    for row in rows {
        let (seeds, executions, renderers, sources) = &found[&key(row)];
        let seeds = (seeds.len() > 1).then(|| format!("seeds {}", row.record().seeds));
        let execution = (executions.len() > 1).then(|| row.execution_text());
        let renderer = (renderers.len() > 1).then(|| row.renderer_text());
        let sources = (sources.len() > 1).then(|| row.sources_text());
        row.apart = seeds.into_iter().chain(execution).chain(renderer).chain(sources).collect::<Vec<_>>().join(", ");
    }
}

/// Trainings of one family that were run alike become one row.
fn joined(evaluations: &[StoredEvaluation], reading: &Reading) -> Vec<LeaderboardRow> {
    let mut alike: BTreeMap<String, Vec<StoredEvaluation>> = BTreeMap::new();
    for evaluation in evaluations.iter().filter(|evaluation| evaluation.record.shard.is_none()) {
        let record = &evaluation.record;
        let who = reading.families.key(&record.entry).map_or_else(|| format!("entry {}", record.entry), str::to_owned);
        let how = (&record.protocol, &record.execution, record.seeds, &record.versions, &record.sources);
        let marks = (record.time_decides, record.demonstrated);
        alike.entry(format!("{who} {how:?} {marks:?}")).or_default().push(evaluation.clone());
    }
    let row = |trainings: Vec<StoredEvaluation>| {
        let mut row = LeaderboardRow::of(trainings);
        row.family = reading.families.key(&row.record().entry).map(str::to_owned);
        row.named = reading.protocols.block_of(row.record());
        row.cameras = reading.cameras_of(&row.record().entry);
        row
    };
    alike.into_values().flat_map(by_renderer).map(row).collect()
}

/// Evaluations of several trainings; where one is there more than once, drawn by different renderers, a list for each of those.
fn by_renderer(evaluations: Vec<StoredEvaluation>) -> Vec<Vec<StoredEvaluation>> {
    let entries: BTreeSet<&EntryIdentity> = evaluations.iter().map(|one| &one.record.entry).collect();
    if entries.len() == evaluations.len() {
        return vec![evaluations];
    }
    let mut lists: BTreeMap<Option<String>, Vec<StoredEvaluation>> = BTreeMap::new();
    for one in evaluations {
        lists.entry(one.record.renderer.clone()).or_default().push(one);
    }
    lists.into_values().collect()
}

/// Leaves out what another row holds already.
fn without_parts(rows: Vec<LeaderboardRow>) -> Vec<LeaderboardRow> {
    let within = |part: &LeaderboardRow, whole: &LeaderboardRow| {
        let (a, b) = (part.record(), whole.record());
        let seeds = b.seeds.start <= a.seeds.start && a.seeds.iter().end <= b.seeds.iter().end && a.seeds != b.seeds;
        let rules = (&a.protocol, &a.execution, &a.versions, &a.sources, &a.renderer)
            == (&b.protocol, &b.execution, &b.versions, &b.sources, &b.renderer);
        let entries = part.evaluations().all(|one| whole.evaluations().any(|two| one.record.entry == two.record.entry));
        seeds && rules && part.named.is_none() && entries
    };
    let mut holding: BTreeMap<EntryIdentity, Vec<usize>> = BTreeMap::new();
    for (at, row) in rows.iter().enumerate() {
        row.evaluations().for_each(|one| holding.entry(one.record.entry.clone()).or_default().push(at));
    }
    let is_part = |row: &LeaderboardRow| holding[&row.record().entry].iter().any(|&other| within(row, &rows[other]));
    let kept: Vec<bool> = rows.iter().map(|row| !is_part(row)).collect();
    rows.into_iter().zip(kept).filter_map(|(row, kept)| kept.then_some(row)).collect()
}

/// Letters and ranks of every row that has a rank, corrected over the whole table.
fn compare_all(rows: &mut [LeaderboardRow]) {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for at in 0..rows.len() {
        if rows[at].rank.is_none() {
            continue;
        }
        match groups.last_mut().filter(|places| group(&rows[places[0]]) == group(&rows[at])) {
            Some(places) => places.push(at),
            None => groups.push(vec![at]),
        }
    }
    let compared: Vec<Vec<&LeaderboardRow>> =
        groups.iter().map(|places| places.iter().map(|&at| &rows[at]).collect()).collect();
    let found = standings(&compared);
    for (places, standings) in groups.into_iter().zip(found) {
        for (at, standing) in places.into_iter().zip(standings) {
            rows[at].standing = standing;
        }
    }
}

/// Best first inside a group: by what the success rate is at least, so that 1 of 1 does not come before 199 of 200. Bounds
/// stand around the others, too few episodes come last; ties by what does not change.
fn order(one: &LeaderboardRow, two: &LeaderboardRow) -> Ordering {
    let seeds = |row: &LeaderboardRow| (row.record().seeds.start, row.record().seeds.count);
    one.too_few()
        .cmp(&two.too_few())
        .then(two.interval.0.total_cmp(&one.interval.0))
        .then(two.counts.episodes.cmp(&one.counts.episodes))
        .then_with(|| one.record().entry.cmp(&two.record().entry))
        .then_with(|| seeds(one).cmp(&seeds(two)))
        .then_with(|| one.record().versions.cmp(&two.record().versions))
        .then_with(|| one.record().sources.cmp(&two.record().sources))
        .then_with(|| one.execution_text().cmp(&two.execution_text()))
}
