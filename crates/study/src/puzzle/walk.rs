//! Walkers: policies that find their way through a maze one move at a time, how they learn it and how they are judged.

use std::collections::{BTreeMap, VecDeque};

use models::{ModelError, Rng, TrainConfig};
use puzzles::{MOVES, Maze, MazeTask, Puzzle, Split, Symmetry, Walker};
use serde::{Deserialize, Serialize};
use solvers::WalkerNet;
use solvers::rl::{Agent, Algorithm, Choice, Decision, Episode, RlConfig};

use super::grade::Counts;

/// Training episodes over which the study counts successes.
const RECENT: usize = 50;

/// Mazes that a policy walks at once when it is judged.
const BATCH: usize = 100;

/// `[rl]`: how a walker learns.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RlSection {
    /// How the policy is improved.
    pub algorithm: RlKind,
    /// Episodes per update (`search`: mazes per update).
    pub episodes: usize,
    /// Discount per step.
    #[serde(default = "default_gamma")]
    pub gamma: f64,
    /// Weight of longer estimates in the advantage.
    #[serde(default = "default_lambda")]
    pub gae_lambda: f64,
    /// Weight of the entropy bonus.
    #[serde(default = "default_entropy")]
    pub entropy_weight: f64,
    /// Weight of the value head's squared error.
    #[serde(default = "default_value")]
    pub value_weight: f64,
    /// Rewards are multiplied by this.
    #[serde(default = "default_scale")]
    pub reward_scale: f64,
    /// Smallest standard deviation by which advantages are divided.
    #[serde(default = "default_floor")]
    pub advantage_std_floor: f64,
    /// PPO: how far the ratio of new to old probability may go.
    #[serde(default = "default_clip")]
    pub clip: f64,
    /// PPO: passes over the episodes.
    #[serde(default = "default_epochs")]
    pub epochs: usize,
    /// PPO: passes end when the KL divergence exceeds this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target_kl: Option<f64>,
    /// PPO: also learn from each episode's mirror images, where the mirrored maze is a training maze.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub mirrored: bool,
}

fn default_gamma() -> f64 {
    0.95
}
fn default_lambda() -> f64 {
    0.95
}
fn default_entropy() -> f64 {
    0.01
}
fn default_value() -> f64 {
    0.5
}
fn default_scale() -> f64 {
    0.1
}
fn default_floor() -> f64 {
    0.1
}
fn default_clip() -> f64 {
    0.2
}
fn default_epochs() -> usize {
    4
}

/// Which algorithm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RlKind {
    /// REINFORCE.
    Reinforce,
    /// Advantage actor-critic.
    A2c,
    /// Proximal policy optimisation.
    Ppo,
    /// No reinforcement: the first moves of shortest ways, found by search, are the labels.
    Search,
}

impl RlSection {
    /// Whether the network needs a value head.
    pub(super) fn wants_value(&self) -> bool {
        matches!(self.algorithm, RlKind::A2c | RlKind::Ppo)
    }

    /// The keys of PPO's own settings, and whether each is not the default.
    pub(super) fn of_ppo(&self) -> [(&'static str, bool); 3] {
        [
            ("rl.clip", self.clip != default_clip()),
            ("rl.epochs", self.epochs != default_epochs()),
            ("rl.target_kl", self.target_kl.is_some()),
        ]
    }

    fn config(&self, batch_size: usize) -> RlConfig {
        let algorithm = match self.algorithm {
            RlKind::Reinforce | RlKind::Search => Algorithm::Reinforce,
            RlKind::A2c => Algorithm::A2c,
            RlKind::Ppo => {
                Algorithm::Ppo { clip: self.clip, epochs: self.epochs, batch_size, target_kl: self.target_kl }
            }
        };
        RlConfig {
            algorithm,
            gamma: self.gamma,
            gae_lambda: self.gae_lambda,
            entropy_weight: self.entropy_weight,
            value_weight: self.value_weight,
            reward_scale: self.reward_scale,
            advantage_std_floor: self.advantage_std_floor,
        }
    }
}

/// What a walker sees: the study's 25 numbers in its empty grid, planes elsewhere.
fn observe(walker: &Walker, task: MazeTask) -> Vec<f32> {
    match task {
        MazeTask::Empty5 => walker.observe_study(),
        _ => walker.observe_planes(),
    }
}

/// Length of an observation.
pub(super) fn observation_len(task: MazeTask) -> usize {
    match task {
        MazeTask::Empty5 => task.side() * task.side(),
        _ => 3 * task.side() * task.side(),
    }
}

type Decide<'a> = dyn FnMut(&[f32], &[u32]) -> Result<Vec<Decision>, ModelError> + 'a;

/// Plays one episode in each maze, all of them side by side; whether each reached its goal.
fn play(task: MazeTask, mazes: &[Maze], decide: &mut Decide<'_>) -> Result<(Vec<Episode>, Vec<bool>), ModelError> {
    let mut walkers: Vec<Walker> = mazes.iter().map(|maze| Walker::new(maze.clone())).collect();
    let mut episodes = vec![Episode::default(); mazes.len()];
    let mut reached = vec![false; mazes.len()];
    let mut going: Vec<usize> = (0..mazes.len()).collect();
    while !going.is_empty() {
        let each: Vec<Vec<f32>> = going.iter().map(|&i| observe(&walkers[i], task)).collect();
        let previous: Vec<u32> = going.iter().map(|&i| episodes[i].previous_action()).collect();
        let decisions = decide(&each.concat(), &previous)?;
        let mut left = Vec::with_capacity(going.len());
        for ((&i, observation), decision) in going.iter().zip(&each).zip(decisions) {
            let moved = walkers[i].act(decision.action as usize);
            episodes[i].push(observation, decision, moved.reward);
            reached[i] = moved.at_goal;
            if !moved.done {
                left.push(i);
            }
        }
        going = left;
    }
    // cut off by the cap on moves: what would have followed is estimated, not nothing
    let cut: Vec<usize> = (0..mazes.len()).filter(|&i| !reached[i]).collect();
    if !cut.is_empty() {
        let seen: Vec<f32> = cut.iter().flat_map(|&i| observe(&walkers[i], task)).collect();
        let previous: Vec<u32> = cut.iter().map(|&i| episodes[i].previous_action()).collect();
        for (&i, decision) in cut.iter().zip(decide(&seen, &previous)?) {
            episodes[i].last_value = decision.value;
        }
    }
    Ok((episodes, reached))
}

/// An episode and its mirror images: what a policy that is itself mirrored would have seen and done, which is why the
/// probabilities at the time stay. Images whose walls belong to another split are left out.
fn mirrored(task: MazeTask, maze: &Maze, episode: &Episode) -> Vec<Episode> {
    let side = task.side();
    let image = |symmetry: Symmetry| {
        let walls = symmetry.plane(side, maze.grid.walls());
        task.split_of(&walls).is_none_or(|split| split == Split::Train).then(|| Episode {
            observations: episode
                .observations
                .chunks(side * side)
                .flat_map(|plane| symmetry.plane(side, plane))
                .collect(),
            actions: episode.actions.iter().map(|&action| symmetry.action(action as usize) as u32).collect(),
            ..episode.clone()
        })
    };
    Symmetry::all().into_iter().filter_map(image).collect()
}

/// Shares of the moves that begin a shortest way from `at`.
fn first_moves(maze: &Maze, at: usize) -> [f32; MOVES.len()] {
    let distances = maze.grid.distances(maze.goal);
    let mut shares = [0.0; MOVES.len()];
    for (share, direction) in shares.iter_mut().zip(MOVES) {
        let nearer = |to: usize| distances[to].zip(distances[at]).is_some_and(|(to, at)| to + 1 == at);
        *share = f32::from(u8::from(maze.grid.step(at, direction).is_some_and(nearer)));
    }
    let sum: f32 = shares.iter().sum();
    shares.map(|share| share / sum)
}

/// A walker in training.
pub(super) struct WalkerTraining {
    agent: Agent,
    section: RlSection,
    task: MazeTask,
    recent: VecDeque<bool>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Meta {
    agent: serde_json::Value,
    recent: VecDeque<bool>,
}

impl WalkerTraining {
    pub(super) fn new(
        net: Box<dyn WalkerNet>,
        section: &RlSection,
        task: MazeTask,
        train: TrainConfig,
        (batch_size, seed): (usize, u64),
    ) -> Result<Self, ModelError> {
        let agent = Agent::new(net, section.config(batch_size), train, seed)?;
        Ok(Self { agent, section: section.clone(), task, recent: VecDeque::new() })
    }

    /// Mazes that the next update wants.
    pub(super) fn wanted(&self) -> usize {
        self.section.episodes
    }

    /// One update; what it measured, by name.
    pub(super) fn step(&mut self, puzzles: &[Puzzle]) -> Result<BTreeMap<String, f64>, ModelError> {
        let mazes: Vec<Maze> = puzzles.iter().filter_map(maze).cloned().collect();
        let values = match self.section.algorithm {
            RlKind::Search => self.imitate(&mazes)?,
            _ => {
                let agent = &mut self.agent;
                let (episodes, reached) =
                    play(self.task, &mazes, &mut |seen, previous| agent.decide(seen, previous, Choice::Sample))?;
                for &reached in &reached {
                    self.recent.push_back(reached);
                    if self.recent.len() > RECENT {
                        self.recent.pop_front();
                    }
                }
                let done = if self.section.mirrored {
                    let seen = mazes.iter().zip(&episodes);
                    let all: Vec<Episode> = seen.flat_map(|(maze, one)| mirrored(self.task, maze, one)).collect();
                    self.agent.update(&all)?
                } else {
                    self.agent.update(&episodes)?
                };
                let rewards: f64 = episodes.iter().map(Episode::total_reward).sum();
                let share = |of: usize, all: usize| of as f64 / all as f64;
                vec![
                    ("loss", done.loss),
                    ("policy_loss", done.policy_loss),
                    ("value_loss", done.value_loss),
                    ("entropy", done.entropy),
                    ("kl", done.kl),
                    ("advantage_std", done.advantage_std),
                    ("grad_norm", done.grad_norm),
                    ("lr", done.lr),
                    ("return", rewards / episodes.len() as f64),
                    ("success", share(reached.iter().filter(|&&r| r).count(), reached.len())),
                    ("recent_success", share(self.recent.iter().filter(|&&r| r).count(), self.recent.len())),
                ]
            }
        };
        Ok(values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
    }

    /// One step towards what search finds, from the start of each maze.
    fn imitate(&mut self, mazes: &[Maze]) -> Result<Vec<(&'static str, f64)>, ModelError> {
        let seen: Vec<f32> = mazes.iter().flat_map(|maze| observe(&Walker::new(maze.clone()), self.task)).collect();
        let targets: Vec<f32> = mazes.iter().flat_map(|maze| first_moves(maze, maze.start)).collect();
        let done = self.agent.imitate(&seen, &vec![0; mazes.len()], &targets)?;
        Ok(vec![("loss", f64::from(done.loss)), ("grad_norm", done.grad_norm), ("lr", done.lr)])
    }

    pub(super) fn evaluated(&self) -> Result<BTreeMap<String, candle_core::Tensor>, ModelError> {
        self.agent.eval_tensors()
    }

    pub(super) fn state(&self) -> Result<(BTreeMap<String, candle_core::Tensor>, serde_json::Value), ModelError> {
        let (tensors, agent) = self.agent.state()?;
        let meta = Meta { agent, recent: self.recent.clone() };
        Ok((tensors, serde_json::to_value(meta).expect("JSON and flags become JSON")))
    }

    pub(super) fn restore(
        &mut self,
        tensors: &BTreeMap<String, candle_core::Tensor>,
        meta: &serde_json::Value,
    ) -> Result<(), ModelError> {
        let meta: Meta = serde_json::from_value(meta.clone())
            .map_err(|e| ModelError::State { object: "walker", detail: e.to_string() })?;
        self.agent.restore(tensors, &meta.agent)?;
        self.recent = meta.recent;
        Ok(())
    }
}

fn maze(puzzle: &Puzzle) -> Option<&Maze> {
    match puzzle {
        Puzzle::Maze(maze) => Some(maze),
        Puzzle::Sudoku(..) => None,
    }
}

/// How a walk ended: moves to the goal, if it was reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Walk {
    pub(super) reached: bool,
    pub(super) moves: usize,
}

/// Walks every maze once: by the most probable move, or by moves drawn with `rng`.
pub(super) fn walk_all(
    net: &dyn WalkerNet,
    task: MazeTask,
    puzzles: &[Puzzle],
    mut rng: Option<&mut Rng>,
) -> Result<Vec<Walk>, ModelError> {
    let mut walks = Vec::with_capacity(puzzles.len());
    for batch in puzzles.chunks(BATCH) {
        let mazes: Vec<Maze> = batch.iter().filter_map(maze).cloned().collect();
        let (episodes, reached) =
            play(task, &mazes, &mut |seen, previous| solvers::rl::decide(net, seen, previous, rng.as_deref_mut()))?;
        walks.extend(episodes.iter().zip(reached).map(|(e, reached)| Walk { reached, moves: e.len() }));
    }
    Ok(walks)
}

/// Every walk as a graded answer: right if the goal was reached, exact if by a shortest way.
pub(super) fn count(puzzles: &[Puzzle], walks: &[Walk]) -> Counts {
    let mut counts = Counts::default();
    for (puzzle, walk) in puzzles.iter().zip(walks) {
        let shortest = walk.reached && puzzle.distance() == Some(walk.moves);
        counts.puzzles += 1;
        counts.valid += u64::from(walk.reached);
        counts.exact += u64::from(shortest);
        counts.walk += u64::from(shortest);
        if maze(puzzle).is_some_and(Maze::has_detour) {
            counts.detours += 1;
            counts.detours_valid += u64::from(walk.reached);
        }
    }
    counts
}

/// What a walker without any preference achieves.
pub(super) fn random_walks(puzzles: &[Puzzle]) -> Counts {
    let mut rng = puzzles::PuzzleRng::new(0, 0);
    let walk = |puzzle: &Puzzle| {
        let mut walker = Walker::new(maze(puzzle)?.clone());
        loop {
            let moved = walker.act(rng.below(MOVES.len()));
            if moved.done {
                return Some(Walk { reached: moved.at_goal, moves: walker.moves() });
            }
        }
    };
    let walks: Vec<Walk> = puzzles.iter().filter_map(walk).collect();
    count(puzzles, &walks)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use puzzles::{Split, Task};

    fn mazes(task: MazeTask, count: u64) -> Vec<Puzzle> {
        (0..count).map(|i| Task::Maze(task).numbered(Split::Test, (0, 0), 1, i)).collect()
    }

    #[test]
    fn a_walker_that_follows_the_search_takes_shortest_ways() {
        let puzzles = mazes(MazeTask::Walls5, 60);
        for puzzle in &puzzles {
            let maze = maze(puzzle).unwrap();
            let mut walker = Walker::new(maze.clone());
            loop {
                let shares = first_moves(maze, walker.at());
                assert!((shares.iter().sum::<f32>() - 1.0).abs() < 1e-6);
                let action = shares.iter().position(|&share| share > 0.0).unwrap();
                if walker.act(action).done {
                    break;
                }
            }
            assert_eq!((walker.at(), Some(walker.moves())), (maze.goal, puzzle.distance()));
        }
    }

    #[test]
    fn mirror_images_of_a_walk_are_walks_in_other_training_mazes() {
        let task = MazeTask::Walls5;
        let mut images = 0;
        for index in 0..40 {
            let puzzle = Task::Maze(task).numbered(Split::Train, (0, 0), 1, index);
            let maze = maze(&puzzle).unwrap();
            let mut rng = puzzles::PuzzleRng::new(7, index);
            let mut drawn = |seen: &[f32], _: &[u32]| {
                let decision = |_| Decision { action: rng.below(4) as u32, log_prob: -1.4, value: 0.5 };
                Ok((0..seen.len() / observation_len(task)).map(decision).collect())
            };
            let (episodes, _) = play(task, std::slice::from_ref(maze), &mut drawn).unwrap();
            let all = mirrored(task, maze, &episodes[0]);
            assert_eq!(all[0], episodes[0]);
            for image in &all {
                let cells = task.side() * task.side();
                let walls: Vec<bool> = image.observations[cells..2 * cells].iter().map(|&x| x == 1.0).collect();
                assert_eq!(task.split_of(&walls), Some(Split::Train));
                assert_eq!((&image.rewards, image.last_value), (&episodes[0].rewards, episodes[0].last_value));
            }
            images += all.len();
        }
        // 1 + 7 * 0.7 of 8 are training mazes, fewer where two images are the same
        assert!((40 * 5..40 * 7).contains(&images), "{images}");
    }

    #[test]
    fn walks_are_counted() {
        let puzzles = mazes(MazeTask::Walls5, 40);
        let walks: Vec<Walk> = puzzles
            .iter()
            .enumerate()
            .map(|(i, p)| Walk { reached: i % 2 == 0, moves: p.distance().unwrap() + usize::from(i % 4 == 0) })
            .collect();
        let counts = count(&puzzles, &walks);
        assert_eq!((counts.puzzles, counts.valid, counts.exact), (40, 20, 10));
        // exact analysis of the uniform policy in the empty grid: 0.323
        let random = random_walks(&mazes(MazeTask::Empty5, 4000));
        assert!((random.share(random.valid) - 0.323).abs() < 0.03, "{random:?}");
    }
}
