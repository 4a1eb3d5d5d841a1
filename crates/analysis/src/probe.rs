//! A linear probe of a policy's thoughts: what can be read from the recursion's states after each supervision step.
//!
//! It asks of tasks whose things point to one another (PickChain): which one is it after i hops? Things are entities made
//! of observation keys `NAME_color` and `NAME_points`, one-hot, and the start is `goal_color`. One regression for each step
//! and number of hops is fitted to how demonstrations begin, their colours renamed at random as in training, and read on
//! the beginnings of fresh episodes; only chains of at least i hops count for i. The same regression on an untrained
//! network says what the observation alone gives away.

use std::path::{Path, PathBuf};

use candle_core::{D, DType, Device, Tensor};
use dataset::WindowBatch;
use models::actrm::Actrm;
use models::{Backend, ModelError, ValuesRef};
use rollout::Ready;
use serde::{Deserialize, Serialize};
use zoo::entry::LoadedEntry;
use zoo::results::{EntryIdentity, Seeds, TrainingFacts};
use zoo::run::{first_windows, locate};
use zoo::{FeatureKeys, Stage, ZooError, write_atomic};

use crate::depth::Start;

/// The longest chain that the demonstrations of PickChain have.
const DEMONSTRATED: usize = 4;
/// Observations examined at once.
const BATCH: usize = 64;
/// Share of a feature's variance that the regression adds to it.
const RIDGE: f64 = 1e-2;

/// What to probe with what.
pub struct ProbeRequest<'a> {
    /// The entry.
    pub entry: &'a LoadedEntry,
    /// Its demonstrations: an HDF5 file or a data set.
    pub data: PathBuf,
    /// Where an HDF5 file is converted to.
    pub work: PathBuf,
    /// Supervision steps.
    pub steps: usize,
    /// How often each demonstration is shown, each time with other names for its colours.
    pub renamings: u64,
}

/// What was read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbeResult {
    /// Version of this form.
    pub format: u32,
    /// The entry.
    pub entry: EntryIdentity,
    /// Where it comes from.
    pub training: TrainingFacts,
    /// Demonstrations that the probe was fitted to.
    pub demonstrations: u64,
    /// How often each was shown.
    pub renamings: u64,
    /// Seeds of the fresh episodes.
    pub seeds: Seeds,
    /// What was read from which state.
    pub readings: Vec<Reading>,
}

/// What was read from one state of the recursion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reading {
    /// The state.
    pub state: String,
    /// Step by step, in each the thing after 0, 1, ... hops and last the end of the chain.
    pub cells: Vec<ProbeCell>,
}

/// How often one thing was read rightly after one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbeCell {
    /// Supervision steps done.
    pub step: usize,
    /// Hops from the start; the end of the chain where there is none.
    pub hops: Option<usize>,
    /// Right ones among chains as long as demonstrations have them.
    pub right: u64,
    /// Those chains.
    pub of: u64,
    /// Right ones among longer chains.
    pub right_beyond: u64,
    /// Those chains.
    pub of_beyond: u64,
}

impl ProbeResult {
    /// The form that this program writes.
    const FORMAT: u32 = 1;

    /// Reads a result.
    ///
    /// # Errors
    /// A file that cannot be read, or is no result.
    pub fn read(path: &Path) -> Result<Self, ZooError> {
        let text = std::fs::read_to_string(path).map_err(ZooError::io("read", path))?;
        let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        let result: Self =
            serde_json::from_str(&text).map_err(|e| malformed(format!("not the result of a probe: {e}")))?;
        if result.format != Self::FORMAT {
            return Err(malformed(format!("format: expected {}, found {}", Self::FORMAT, result.format)));
        }
        Ok(result)
    }

    /// Writes it.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ZooError> {
        let mut text = serde_json::to_string(self).expect("plain fields are always JSON");
        text = text.replace("{\"step\":", "\n{\"step\":");
        text.push('\n');
        Ok(write_atomic(path, text.as_bytes())?)
    }
}

/// Numbers of a feature.
#[derive(Debug, Clone, PartialEq)]
struct Span {
    feature: String,
    from: usize,
    width: usize,
}

/// Where things and their pointers stand in the features.
#[derive(Debug, PartialEq)]
struct Chain {
    /// (colour, colour that it points to) of each thing
    things: Vec<(Span, Span)>,
    start: Span,
}

impl Chain {
    /// # Errors
    /// In words: what is missing.
    fn find(keys: &FeatureKeys, ready: &Ready) -> Result<Self, String> {
        let mut spans: Vec<(String, Span)> = Vec::new();
        for feature in keys.features() {
            let mut from = 0;
            for item in keys.items(feature) {
                let width_of = |key: &str| ready.observations.get(key).map(|shape| shape.iter().product());
                let width = item.width(width_of)?;
                spans.push((item.to_string(), Span { feature: feature.to_owned(), from, width }));
                from += width;
            }
        }
        let find = |key: &str| spans.iter().find(|(name, _)| name == key).map(|(_, span)| span.clone());
        let things: Vec<(Span, Span)> = spans
            .iter()
            .filter_map(|(name, color)| {
                let points = find(&format!("{}_points", name.strip_suffix("_color")?))?;
                Some((color.clone(), points))
            })
            .collect();
        match find("goal_color") {
            Some(start) if !things.is_empty() => Ok(Self { things, start }),
            _ => Err("observation keys NAME_color, NAME_points and goal_color".to_owned()),
        }
    }

    /// The colours along the chain, from the start to its end.
    fn follow<'v>(&self, of: &dyn Fn(&Span) -> &'v [f32]) -> Vec<usize> {
        let color = |span: &Span| {
            let values = of(span);
            (0..values.len()).max_by(|a, b| values[*a].total_cmp(&values[*b])).unwrap_or_default()
        };
        let mut along = vec![color(&self.start)];
        while along.len() <= self.things.len() {
            let here = along[along.len() - 1];
            let Some((_, points)) = self.things.iter().find(|(own, _)| color(own) == here) else { break };
            match color(points) {
                onward if onward == here => break,
                onward => along.push(onward),
            }
        }
        along
    }
}

/// States after each step, and the chains that they are about.
#[derive(Default)]
struct Samples {
    /// by step, row-major
    reasoning: Vec<Vec<f32>>,
    answer: Vec<Vec<f32>>,
    chains: Vec<Vec<usize>>,
}

impl Samples {
    fn add(
        &mut self,
        model: &Actrm,
        observation: &models::Features<Tensor>,
        steps: usize,
        chains: Vec<Vec<usize>>,
    ) -> Result<(), ModelError> {
        self.reasoning.resize(steps, Vec::new());
        self.answer.resize(steps, Vec::new());
        for (at, step) in model.examine(observation, steps, None)?.iter().enumerate() {
            self.reasoning[at].extend(step.reasoning.flatten_all()?.to_vec1::<f32>()?);
            self.answer[at].extend(step.answer.mean(1)?.flatten_all()?.to_vec1::<f32>()?);
        }
        self.chains.extend(chains);
        Ok(())
    }
}

/// Fits and reads the probe. `fresh` are the beginnings of episodes that no training has seen.
///
/// # Errors
/// An entry that does not think, or whose task has no chains; demonstrations that cannot be read.
pub fn probe(
    request: &ProbeRequest<'_>,
    ready: &Ready,
    seeds: Seeds,
    fresh: &[Start],
) -> Result<ProbeResult, ZooError> {
    let entry = request.entry;
    let unfit = |what: &str, expected: &str, found: String| ZooError::UnfitEntry {
        entry: entry.entry().id().to_string(),
        task: ready.task.clone(),
        what: what.to_owned(),
        expected: expected.to_owned(),
        found,
    };
    let config = entry.experiment().policy.reasoner();
    let (Some(model), Some(config)) = (entry.reasoner()?, config) else {
        return Err(unfit("policy", "one that reasons step by step", entry.experiment().policy_type()));
    };
    let keys = &entry.entry().meta().keys;
    let chain = Chain::find(keys, ready).map_err(|expected| unfit("task", &expected, "none".to_owned()))?;
    let failed = |source| entry.failed("examine", source);
    let untrained = Actrm::new(config, entry.preprocess().signature(), 1, &Backend::CPU).map_err(failed)?;

    let data = locate(&request.data)?;
    let (windows, transforms, firsts) = first_windows(&data, &request.work, entry.experiment())?;
    let mut fitted = [Samples::default(), Samples::default()];
    let mut gathered = WindowBatch::default();
    for renaming in 0..request.renamings {
        for chunk in firsts.chunks(BATCH) {
            windows.gather(chunk, &mut gathered);
            // far from the steps of any training
            let step = u64::MAX - renaming * firsts.len() as u64 - u64::from(chunk[0]);
            transforms.apply(Stage::Probe(step), &mut gathered);
            let chains = (0..chunk.len()).map(|row| {
                chain.follow(&|span| {
                    let column = gathered.column(&span.feature).unwrap_or(&[]);
                    let dim = column.len() / (gathered.n * gathered.n_obs_steps);
                    let last = (row * gathered.n_obs_steps + gathered.n_obs_steps - 1) * dim;
                    &column[last + span.from..][..span.width]
                })
            });
            let chains: Vec<_> = chains.collect();
            let numbers = gathered.observation.iter();
            let observation = numbers.map(|(name, values)| (name.clone(), ValuesRef::F32(values))).collect();
            let horizon = entry.experiment().policy.action_horizon();
            let batch =
                entry.preprocess().batch(horizon, &observation, &gathered.actions, &gathered.is_pad).map_err(failed)?;
            for (samples, model) in fitted.iter_mut().zip([&*model, &untrained]) {
                samples.add(model, &batch.observation, request.steps, chains.clone()).map_err(failed)?;
            }
        }
    }
    let mut read = [Samples::default(), Samples::default()];
    for start in fresh {
        let chain = chain.follow(&|span| {
            let values = start.observation.get(&span.feature).and_then(models::Values::numbers).unwrap_or(&[]);
            &values[span.from..][..span.width]
        });
        let observation = entry.preprocess().observation(std::slice::from_ref(&start.observation)).map_err(failed)?;
        for (samples, model) in read.iter_mut().zip([&*model, &untrained]) {
            samples.add(model, &observation, request.steps, vec![chain.clone()]).map_err(failed)?;
        }
    }
    let subject = entry.subject();
    let colors = chain.start.width;
    let reading = |state: &str, which: usize, of: fn(&Samples) -> &Vec<Vec<f32>>| -> Result<Reading, ZooError> {
        let mut cells = Vec::new();
        for step in 0..request.steps {
            let (fit, new) = (&fitted[which], &read[which]);
            let (a, b) = ((&of(fit)[step], &fit.chains), (&of(new)[step], &new.chains));
            let found = read_step(a, b, colors).map_err(|source| failed(source.into()))?;
            cells.extend(found.into_iter().map(|cell| ProbeCell { step: step + 1, ..cell }));
        }
        Ok(Reading { state: state.to_owned(), cells })
    };
    Ok(ProbeResult {
        format: ProbeResult::FORMAT,
        entry: subject.entry.clone(),
        training: subject.training.clone(),
        demonstrations: firsts.len() as u64,
        renamings: request.renamings,
        seeds,
        readings: vec![
            reading("reasoning", 0, |samples| &samples.reasoning)?,
            reading("answer", 0, |samples| &samples.answer)?,
            reading("reasoning of an untrained network", 1, |samples| &samples.reasoning)?,
        ],
    })
}

/// States, row-major, and the chains that they are about.
type Seen<'a> = (&'a Vec<f32>, &'a Vec<Vec<usize>>);

/// Ridge regressions from `fitted` onto colours, one for each number of hops and one for the end, read on `fresh`.
fn read_step(fitted: Seen<'_>, fresh: Seen<'_>, colors: usize) -> candle_core::Result<Vec<ProbeCell>> {
    let matrix = |(values, chains): Seen<'_>| -> candle_core::Result<Tensor> {
        let rows = chains.len();
        Tensor::from_slice(values, (rows, values.len() / rows.max(1)), &Device::Cpu)?.to_dtype(DType::F64)
    };
    let x = matrix(fitted)?;
    let mean = x.mean_keepdim(0)?;
    let deviation = (x.broadcast_sub(&mean)?.sqr()?.mean_keepdim(0)? + 1e-12)?.sqrt()?;
    let scaled = |x: &Tensor| -> candle_core::Result<Tensor> {
        let x = x.broadcast_sub(&mean)?.broadcast_div(&deviation)?;
        Tensor::cat(&[&x, &Tensor::ones((x.dim(0)?, 1), DType::F64, &Device::Cpu)?], 1)
    };
    let (x, new) = (scaled(&x)?, scaled(&matrix(fresh)?)?);
    let mut cells = Vec::new();
    for hops in (0..=DEMONSTRATED).map(Some).chain([None]) {
        let long_enough = |chain: &[usize]| hops.is_none_or(|hops| chain.len() > hops);
        let answer = |chain: &[usize]| hops.map_or(chain[chain.len() - 1], |hops| chain[hops]);
        let rows: Vec<u32> = (0..fitted.1.len()).filter(|&i| long_enough(&fitted.1[i])).map(|i| i as u32).collect();
        let mut cell = ProbeCell { step: 0, hops, right: 0, of: 0, right_beyond: 0, of_beyond: 0 };
        if !rows.is_empty() {
            let mut targets = vec![0.0; rows.len() * colors];
            for (target, &row) in targets.chunks_exact_mut(colors).zip(&rows) {
                target[answer(&fitted.1[row as usize])] = 1.0;
            }
            let chosen = x.index_select(&Tensor::new(rows.as_slice(), &Device::Cpu)?, 0)?;
            let y = Tensor::from_vec(targets, (rows.len(), colors), &Device::Cpu)?;
            let weights = ridge(&chosen, &y)?;
            let guesses = new.matmul(&weights)?.argmax(D::Minus1)?.to_vec1::<u32>()?;
            for (chain, guess) in fresh.1.iter().zip(guesses).filter(|(chain, _)| long_enough(chain)) {
                let right = u64::from(answer(chain) == guess as usize);
                let (count, of) = match chain.len() <= DEMONSTRATED + 1 {
                    true => (&mut cell.right, &mut cell.of),
                    false => (&mut cell.right_beyond, &mut cell.of_beyond),
                };
                (*count, *of) = (*count + right, *of + 1);
            }
        }
        cells.push(cell);
    }
    Ok(cells)
}

/// x: (n, d), y: (n, c) -> (d, c) that minimises the mean square of `x w - y` plus [`RIDGE`] times that of w.
fn ridge(x: &Tensor, y: &Tensor) -> candle_core::Result<Tensor> {
    let (n, d) = x.dims2()?;
    let transposed = x.t()?.contiguous()?;
    let mut gram = transposed.matmul(x)?.to_vec2::<f64>()?;
    let mut right = transposed.matmul(y)?.to_vec2::<f64>()?;
    for (i, row) in gram.iter_mut().enumerate() {
        row[i] += RIDGE * n as f64;
    }
    // Cholesky: the lower triangle in place, row by row, then two substitutions
    for i in 0..d {
        let (above, rest) = gram.split_at_mut(i);
        let row = &mut rest[0];
        for (j, other) in above.iter().enumerate() {
            let known: f64 = row[..j].iter().zip(other).map(|(a, b)| a * b).sum();
            row[j] = (row[j] - known) / other[j];
        }
        let known: f64 = row[..i].iter().map(|a| a * a).sum();
        row[i] = (row[i] - known).sqrt();
    }
    for column in 0..right[0].len() {
        for i in 0..d {
            let known: f64 = (0..i).map(|k| gram[i][k] * right[k][column]).sum();
            right[i][column] = (right[i][column] - known) / gram[i][i];
        }
        for i in (0..d).rev() {
            let known: f64 = (i + 1..d).map(|k| gram[k][i] * right[k][column]).sum();
            right[i][column] = (right[i][column] - known) / gram[i][i];
        }
    }
    Tensor::new(right, &Device::Cpu)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn normals(n: usize) -> Vec<f32> {
        models::Rng::new(3, "probe").normals(n)
    }

    #[test]
    fn the_regression_solves_its_normal_equations() {
        let x = Tensor::from_vec(normals(40 * 6), (40, 6), &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
        let y = Tensor::from_vec(normals(40 * 3), (40, 3), &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
        let w = ridge(&x, &y).unwrap();
        let residual = (x.matmul(&w).unwrap() - &y).unwrap();
        let slope = (x.t().unwrap().matmul(&residual).unwrap() + (w * (RIDGE * 40.0)).unwrap()).unwrap();
        let largest = slope.abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap();
        assert!(largest < 1e-9, "{largest:e}");
    }

    #[test]
    fn what_is_there_is_read_and_what_is_not_is_not() {
        // 5 colours in chains of 1 to 7; the state shows the third thing alone
        let mut rng = models::Rng::new(4, "chains");
        let chains: Vec<Vec<usize>> =
            (0..600).map(|i| (0..1 + i % 7).map(|_| rng.below(5) as usize).collect()).collect();
        let noise = normals(600 * 8);
        let states: Vec<f32> = chains
            .iter()
            .zip(noise.chunks_exact(8))
            .flat_map(|(chain, noise)| {
                let shown = chain.get(2).copied();
                noise.iter().enumerate().map(move |(i, x)| x * 0.1 + f32::from(u8::from(Some(i) == shown)))
            })
            .collect();
        let half = 300;
        let (fit, new) = (
            (states[..half * 8].to_vec(), chains[..half].to_vec()),
            (states[half * 8..].to_vec(), chains[half..].to_vec()),
        );
        let cells = read_step((&fit.0, &fit.1), (&new.0, &new.1), 5).unwrap();
        assert_eq!(cells.len(), DEMONSTRATED + 2);
        assert_eq!((cells[2].hops, cells[2].right, cells[2].right_beyond), (Some(2), cells[2].of, cells[2].of_beyond));
        // chains of 3 to 5 things, and of 6 and 7
        let count =
            |range: std::ops::RangeInclusive<usize>| chains[half..].iter().filter(|c| range.contains(&c.len())).count();
        assert_eq!((cells[2].of, cells[2].of_beyond), (count(3..=5) as u64, count(6..=7) as u64));
        assert!(cells[0].right * 2 < cells[0].of, "{:?}", cells[0]);
        assert_eq!(cells[5].hops, None);
    }

    #[test]
    fn a_chain_is_followed_to_the_one_that_points_to_itself() {
        let span = |feature: &str, from: usize| Span { feature: feature.to_owned(), from, width: 4 };
        let thing = |name: &str| (span(name, 0), span(name, 4));
        let chain = Chain { things: ["a", "b", "c"].map(thing).to_vec(), start: span("goal", 0) };
        let one = |color: usize| (0..4).map(|i| f32::from(u8::from(i == color))).collect::<Vec<_>>();
        let of = |feature: &str| -> Vec<f32> {
            match feature {
                "a" => [one(2), one(0)].concat(),
                "b" => [one(0), one(3)].concat(),
                "c" => [one(3), one(3)].concat(),
                _ => one(2),
            }
        };
        let values: std::collections::BTreeMap<&str, Vec<f32>> = ["a", "b", "c", "goal"].map(|f| (f, of(f))).into();
        let along = chain.follow(&|span| &values[span.feature.as_str()][span.from..][..span.width]);
        assert_eq!(along, [2, 0, 3]);
    }
}
