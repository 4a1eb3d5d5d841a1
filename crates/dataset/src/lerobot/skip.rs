//! Demos that cannot be converted: by default the source is refused because of the first, and where the user says so they
//! are left out.

use super::convert::tasks;
use super::encode::Job;
use super::encoded;
use super::features::{ConvertOptions, ImageForm, Mapping};
use super::info::SkippedDemo;
use super::schema;
use super::shards::GroupEncoder;
use super::side::SideEncoder;
use super::work;
use crate::error::{DatasetError, InputError, Result};
use crate::plan::Plan;
use crate::source::Source;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The demos that cannot be converted whatever columns are chosen, and why: those that cannot be opened first. One may come
/// twice.
fn hopeless(plan: &Plan) -> impl Iterator<Item = (&str, &InputError)> {
    let whole = plan.problems.iter().filter(|p| p.fatal && p.key.is_none());
    plan.lost().chain(whole.filter_map(|p| Some((p.demo.as_deref()?, &p.error))))
}

/// Refuses a source with such a demo.
pub(super) fn none(source: &Source) -> Result<()> {
    hopeless(source.plan()).next().map_or(Ok(()), |(_, error)| Err(error.clone().into()))
}

/// Leaves out of `source` every demo that cannot be converted. Gives the columns of the others, and those left out, in
/// the order of the demos.
pub(super) fn bad(source: &mut Source, options: &ConvertOptions, root: &Path) -> Result<(Mapping, Vec<SkippedDemo>)> {
    let mut skipped: Vec<(u64, SkippedDemo)> = Vec::new();
    let order: BTreeMap<String, u64> = source.plan().demos.iter().map(|d| (d.id.clone(), d.number)).collect();
    let mut skip = |source: &mut Source, bad: &[(String, DatasetError)]| {
        let path = source.plan().path.display().to_string();
        for (id, error) in bad {
            let text = error.to_string();
            // a data set says nothing of the machine that it was made on
            let rest = text.strip_prefix(&path).map(|rest| rest.trim_start_matches([':', '/', ' ']));
            let reason = rest.unwrap_or(&text).to_owned();
            let number = order.get(id).copied().or_else(|| id.rsplit('_').next()?.parse().ok()).unwrap_or(u64::MAX);
            skipped.push((number, SkippedDemo { demo: id.clone(), reason }));
        }
        let ids: BTreeSet<&str> = bad.iter().map(|(id, _)| id.as_str()).collect();
        source.leave_out(&ids);
        match skipped.last().filter(|_| source.plan().demos.is_empty()) {
            Some((_, last)) => Err(InputError::NoDemos {
                path: source.plan().path.clone(),
                found: format!("{} that cannot be converted, the last of them: {}", skipped.len(), last.reason),
            }),
            None => Ok(()),
        }
    };
    let mut known = BTreeSet::new();
    let lost = hopeless(source.plan()).filter(|(id, _)| known.insert(id.to_owned()));
    let lost: Vec<(String, DatasetError)> = lost.map(|(id, error)| (id.to_owned(), error.clone().into())).collect();
    skip(source, &lost)?;
    let mut mapping = loop {
        let error = match Mapping::resolve(source.plan(), options, &encoded::sizes(source)?) {
            Ok(mapping) => break mapping,
            Err(DatasetError::Input(error)) => error,
            Err(error) => return Err(error),
        };
        let plan = source.plan();
        let of_problem = || plan.problems.iter().find(|p| p.error == error)?.demo.clone();
        match error.demo().map(str::to_owned).or_else(of_problem).filter(|id| plan.position(id).is_some()) {
            Some(id) => skip(source, &[(id, error.into())])?,
            None => return Err(error.into()),
        }
    };
    source.exempt(mapping.depth_keys());
    let before = source.plan().demos.len();
    let failing = failing(source, &mapping, options, root)?.into_iter();
    let failing: Vec<(String, DatasetError)> =
        failing.map(|(index, error)| (source.plan().demos[index].id.clone(), error)).collect();
    skip(source, &failing)?;
    if source.plan().demos.len() < before {
        mapping = Mapping::resolve(source.plan(), options, &encoded::sizes(source)?)?;
    }
    skipped.sort_by_key(|(number, _)| *number);
    Ok((mapping, skipped.into_iter().map(|(_, demo)| demo).collect()))
}

/// Whether the demo is at fault, and something can be said of those after it.
fn of_demo(error: &DatasetError) -> bool {
    !matches!(
        error,
        DatasetError::Video(_)
            | DatasetError::Ffmpeg { .. }
            | DatasetError::Io { .. }
            | DatasetError::Parquet { .. }
            | DatasetError::Input(
                InputError::ReaderDied { .. }
                    | InputError::ReaderSilent { .. }
                    | InputError::ReaderStart { .. }
                    | InputError::Unreadable { .. }
            )
    )
}

/// Converts each demo by itself and throws the result away: gives those that fail, in order.
fn failing(
    source: &Source,
    mapping: &Mapping,
    options: &ConvertOptions,
    root: &Path,
) -> Result<Vec<(usize, DatasetError)>> {
    let (_, task_of) = tasks(&source.plan().path, source.plan());
    let features = mapping.features();
    let arrow_schema = schema::data_schema(&features);
    let encoder = schema::writer_properties(&arrow_schema, Vec::new())
        .and_then(|properties| GroupEncoder::new(arrow_schema, properties))
        .map_err(|source| DatasetError::Parquet { path: root.join("data"), operation: "prepare writing it", source })?;
    let side = match options.lossless {
        true => Some(SideEncoder::new(root, source.plan(), &mapping.columns, options.video.as_ref())?),
        false => None,
    };
    let job = Job {
        path: &source.plan().path,
        source,
        mapping,
        images: ImageForm::Ppm,
        video: options.video.as_ref(),
        nonfinite: options.nonfinite,
        lossless: options.lossless,
        encoder: &encoder,
        task_of: &task_of,
    };
    let parts: Vec<work::Part> =
        work::cut(&source.plan().demos, mapping, options.lossless, u64::MAX).into_iter().flatten().collect();
    let mut failed: BTreeMap<usize, DatasetError> = BTreeMap::new();
    work::in_order(
        parts.len(),
        options.threads(),
        |index| {
            let part = &parts[index];
            let tried = job.load(std::slice::from_ref(part)).and_then(|mut loaded| {
                side.as_ref().map(|side| side.encode(&job, &loaded)).transpose()?;
                job.encode(&mut loaded).map(drop)
            });
            match tried {
                Ok(()) => Ok(None),
                Err(error) if of_demo(&error) => Ok(Some((part.episode, error))),
                Err(error) => Err(error),
            }
        },
        |found| {
            if let Some((episode, error)) = found {
                failed.entry(episode).or_insert(error);
            }
            Ok(())
        },
    )?;
    Ok(failed.into_iter().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_demo_is_blamed_for_the_machine() {
        let (path, reason) = (Path::new("x").to_owned(), String::new());
        let unreadable = InputError::Unreadable { path: path.clone(), reason: reason.clone() };
        let source = std::io::ErrorKind::StorageFull.into();
        for error in [
            DatasetError::Input(unreadable),
            DatasetError::Ffmpeg { reason },
            DatasetError::Io { path: path.clone(), operation: "write it", source },
        ] {
            assert!(!of_demo(&error), "{error}");
        }
        assert!(of_demo(&DatasetError::Input(InputError::NoDemos { path, found: String::new() })));
    }
}
