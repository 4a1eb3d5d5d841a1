//! What a data set calls the numbers of a column, held against the items that an experiment reads it as.

use std::collections::{BTreeMap, VecDeque};

use dataset::KeyItem;
use models::ACTION;

/// What names say of a column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Names {
    /// They are those that are read: number `i` is at place `order[i]`, and a converter calls it `names[i]`.
    Are { order: Vec<usize>, names: Vec<String> },
    /// They say nothing: there are none, or they count.
    Silent,
    /// They are those of something else.
    Other,
}

/// What `names` say of a column that is to hold the numbers of `items`.
pub(super) fn of_items(items: &[KeyItem], names: &[String]) -> Names {
    if KeyItem::widths(items, names).is_some() {
        return Names::Are { order: (0..names.len()).collect(), names: names.to_vec() };
    }
    let canonical = canonical_of(names);
    match order_of(items, &canonical) {
        Some((order, names)) => Names::Are { order, names },
        None if says_nothing(&canonical) => Names::Silent,
        None => Names::Other,
    }
}

/// What `names` say of the actions of a simulated arm: position, rotation, gripper.
pub(super) fn of_action(names: &[String]) -> Names {
    let are = |order: Vec<usize>| {
        let names = (0..order.len()).map(|i| format!("{ACTION}_{i}")).collect();
        Names::Are { order, names }
    };
    if let Some(order) = counted(names) {
        return are(order);
    }
    let canonical = canonical_of(names);
    match places_of(canonical.iter().map(|name| place_in_action(name))).filter(|order| order.len() == ARM) {
        Some(order) => are(order),
        None if says_nothing(&canonical) => Names::Silent,
        None => Names::Other,
    }
}

/// Whether they are a converter's: `action_0`, `action_1`, …
pub(super) fn is_counted(names: &[String]) -> bool {
    counted(names).is_some_and(|order| order.is_sorted())
}

fn counted(names: &[String]) -> Option<Vec<usize>> {
    places_of(names.iter().map(|name| name.strip_prefix(ACTION)?.strip_prefix('_')?.parse().ok()))
}

/// Where each of the numbers 0, 1, … is in a list that holds each once.
fn places_of(numbers: impl Iterator<Item = Option<usize>>) -> Option<Vec<usize>> {
    let numbers: Vec<usize> = numbers.collect::<Option<_>>()?;
    let order: Option<Vec<usize>> =
        (0..numbers.len()).map(|wanted| numbers.iter().position(|&number| number == wanted)).collect();
    order.filter(|order| !order.is_empty())
}

/// In which order numbers of these names are those of `items`, if they are, and what a converter calls them.
fn order_of(items: &[KeyItem], canonical: &[String]) -> Option<(Vec<usize>, Vec<String>)> {
    let mut places: BTreeMap<&str, VecDeque<usize>> = BTreeMap::new();
    for (place, name) in canonical.iter().enumerate() {
        places.entry(name).or_default().push_back(place);
    }
    let (mut order, mut usual) = (Vec::with_capacity(canonical.len()), Vec::new());
    for item in items {
        let named = |width: usize| -> Vec<String> { item.names(width).map(|name| canonical_name(&name)).collect() };
        // a key of one number is called by its name, by others with its place
        let alone = [named(1).concat(), format!("{}_0", named(1).concat())];
        let mut widths = (2..=canonical.len()).rev().map(named).chain(alone.map(|name| vec![name]));
        let there = |name: &String| places.get(name.as_str()).is_some_and(|at| !at.is_empty());
        let names = widths.find(|names| names.iter().all(there))?;
        usual.extend(item.names(names.len()));
        order.extend(names.iter().filter_map(|name| places.get_mut(name.as_str())?.pop_front()));
    }
    (order.len() == canonical.len()).then_some((order, usual))
}

/// Names in one way of writing. A name that stands at several places in a row counts them.
fn canonical_of(names: &[String]) -> Vec<String> {
    let single: Vec<String> = names.iter().map(|name| canonical_name(name)).collect();
    let mut counted = single.clone();
    for (place, name) in single.iter().enumerate() {
        let first = single[..place].iter().rposition(|other| other != name).map_or(0, |at| at + 1);
        if place > first || single.get(place + 1) == Some(name) {
            counted[place] = format!("{name}_{}", place - first);
        }
    }
    counted
}

/// What simulated arms' keys are called elsewhere.
const ALIASES: [(&str, &[&str]); 3] = [
    ("eef_pos", &["", "pos", "position", "ee_pos", "eef_position", "ee_position", "tcp_pos", "tcp_position"]),
    ("eef_quat", &["quat", "quaternion", "ee_quat", "eef_quaternion", "ee_quaternion", "tcp_quat", "orientation"]),
    ("gripper_qpos", &["gripper", "gripper_pos", "gripper_position", "gripper_state", "gripper_joint"]),
];

/// `robot0_eef_pos_0` of it, of `eef_pos.x`, of `EEF_pos[0]` and of `x`: `eef_pos_0`.
fn canonical_name(name: &str) -> String {
    let plain: String = name.to_lowercase().chars().map(|c| if "./[ -".contains(c) { '_' } else { c }).collect();
    let plain = plain.replace(']', "");
    let plain = plain.strip_prefix("robot0_").unwrap_or(&plain);
    let (base, place) = plain.rsplit_once('_').unwrap_or(match plain {
        "x" | "y" | "z" => ("", plain),
        "qx" | "qy" | "qz" | "qw" => ("quat", &plain[1..]),
        _ => (plain, ""),
    });
    let place = match place {
        "x" => "0",
        "y" => "1",
        "z" => "2",
        "w" => "3",
        other => other,
    };
    let (base, place) = match place.is_empty() || place.chars().all(|c| c.is_ascii_digit()) {
        true => (base, place),
        false => (plain, ""),
    };
    let alias = ALIASES.iter().find(|(_, others)| others.contains(&base) && !(base.is_empty() && place.is_empty()));
    let base = match alias {
        // "0", "1": counted, not named
        Some(_) if base.is_empty() && !plain.starts_with(['x', 'y', 'z']) => "",
        Some((usual, _)) => usual,
        None => base,
    };
    [base, place].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("_")
}

/// Numbers of an action of one arm.
const ARM: usize = 7;

/// Which of an arm's numbers a canonical name is: 0 to 2 position, 3 to 5 rotation, 6 gripper.
fn place_in_action(name: &str) -> Option<usize> {
    let name = name.strip_suffix("_ee").unwrap_or(name);
    let prefixes = ["action_", "target_", "goal_", "delta_"].iter();
    let name = prefixes.fold(name, |name, prefix| name.strip_prefix(prefix).unwrap_or(name));
    let axis = |text: &str| ["0", "1", "2"].iter().position(|place| *place == text);
    let (base, place) = name.rsplit_once('_').unwrap_or((name, ""));
    match (base, place) {
        ("eef_pos", place) => axis(place),
        ("rot" | "rotation" | "axis_angle" | "rotvec" | "eef_rot", place) => axis(place).map(|axis| 3 + axis),
        _ => match name {
            "0" | "x" | "dx" => Some(0),
            "1" | "y" | "dy" => Some(1),
            "2" | "z" | "dz" => Some(2),
            "roll" | "rx" | "drx" | "droll" => Some(3),
            "pitch" | "ry" | "dry" | "dpitch" => Some(4),
            "yaw" | "rz" | "drz" | "dyaw" => Some(5),
            "gripper_qpos" | "gripper_action" | "grip" | "grasp" => Some(6),
            _ => None,
        },
    }
}

/// Words that say no more than that there is a number.
const WORDS: [&str; 28] = [
    "",
    "a",
    "action",
    "actions",
    "channel",
    "component",
    "dim",
    "element",
    "env",
    "environment",
    "feature",
    "idx",
    "index",
    "j",
    "joint",
    "joints",
    "left",
    "motor",
    "motors",
    "obs",
    "observation",
    "pos",
    "qpos",
    "right",
    "s",
    "state",
    "value",
    "vel",
];

/// Whether names say no more than how many numbers there are.
fn says_nothing(canonical: &[String]) -> bool {
    let plain = |word: &str| WORDS.contains(&word.trim_end_matches(|c: char| c.is_ascii_digit()));
    canonical.iter().all(|name| name.split('_').all(plain))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const STATE: [&str; 3] = ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"];

    fn compare(items: &[&str], names: &str) -> Names {
        let items: Vec<KeyItem> = items.iter().map(|item| item.parse().unwrap()).collect();
        of_items(&items, &listed(names))
    }

    fn order(names: Names) -> Option<Vec<usize>> {
        match names {
            Names::Are { order, names } => {
                assert_eq!(order.len(), names.len());
                Some(order)
            }
            Names::Silent | Names::Other => None,
        }
    }

    fn listed(names: &str) -> Vec<String> {
        names.split_whitespace().map(str::to_owned).collect()
    }

    #[test]
    fn a_column_is_put_into_the_order_that_is_read() {
        for names in [
            "robot0_gripper_qpos_0 robot0_gripper_qpos_1 robot0_eef_quat_0 robot0_eef_quat_1 robot0_eef_quat_2 \
             robot0_eef_quat_3 robot0_eef_pos_0 robot0_eef_pos_1 robot0_eef_pos_2",
            "gripper_0 gripper_1 quaternion_x quaternion_y quaternion_z quaternion_w position_x position_y position_z",
            "gripper.0 gripper.1 qx qy qz qw x y z",
            "gripper[0] gripper[1] eef_quat.x eef_quat.y eef_quat.z eef_quat.w eef_pos.x eef_pos.y eef_pos.z",
            "gripper gripper quaternion quaternion quaternion quaternion position position position",
        ] {
            let Names::Are { order, names: usual } = compare(&STATE, names) else { panic!("{names}") };
            assert_eq!(order, [6, 7, 8, 2, 3, 4, 5, 0, 1], "{names}");
            assert_eq!((usual[0].as_str(), usual[8].as_str()), ("robot0_eef_pos_0", "robot0_gripper_qpos_1"));
        }
        // the scalar first, as MuJoCo has quaternions
        let scalar_first = compare(&STATE, "x y z qw qx qy qz gripper_0 gripper_1");
        assert_eq!(order(scalar_first).unwrap(), [0, 1, 2, 4, 5, 6, 3, 7, 8]);
        // as it is read: parts, differences, a key twice
        let items = ["a", "b[1:3]", "b[0:2] - a", "a"];
        let names = ["a", "b_1", "b_2", "b[0:2] - a_0", "b[0:2] - a_1", "a"].map(str::to_owned);
        let items: Vec<KeyItem> = items.iter().map(|item| item.parse().unwrap()).collect();
        assert_eq!(order(of_items(&items, &names)).unwrap(), [0, 1, 2, 3, 4, 5]);
        let moved = [3, 4, 0, 1, 2, 5].map(|place: usize| names[place].clone());
        assert_eq!(order(of_items(&items, &moved)).unwrap(), [2, 3, 4, 0, 1, 5]);
    }

    #[test]
    fn names_that_only_count_are_no_names() {
        for names in [
            "",
            "0 1 2 3 4 5 6 7 8",
            "state_0 state_1 state_2",
            "motor_0 motor_1",
            "joint_0.pos joint_1.pos",
            "left_joint_0 left_joint_1 right_joint_0",
            "s0 s1",
            "state state state",
        ] {
            assert_eq!(compare(&STATE, names), Names::Silent, "{names}");
            assert_eq!(of_action(&listed(names)), Names::Silent, "{names}");
        }
    }

    #[test]
    fn names_of_something_else_are_other() {
        for names in [
            "shoulder_pan.pos shoulder_lift.pos elbow_flex.pos wrist_flex.pos wrist_roll.pos gripper.pos",
            "left_waist left_shoulder left_elbow",
            // one too few, one too many
            "x y z qx qy qz qw",
            "x y z qx qy qz qw gripper_0 gripper_1 velocity",
            "cube_pos_0 cube_pos_1 cube_pos_2",
        ] {
            assert_eq!(compare(&STATE, names), Names::Other, "{names}");
        }
    }

    #[test]
    fn actions_are_position_rotation_and_gripper() {
        for names in [
            "action_0 action_1 action_2 action_3 action_4 action_5 action_6",
            "x y z roll pitch yaw gripper",
            "delta_x_ee delta_y_ee delta_z_ee rx ry rz gripper",
            "dx dy dz drx dry drz grip",
            "eef_pos_0 eef_pos_1 eef_pos_2 axis_angle_0 axis_angle_1 axis_angle_2 gripper_action",
        ] {
            assert_eq!(order(of_action(&listed(names))).unwrap(), [0, 1, 2, 3, 4, 5, 6], "{names}");
        }
        assert_eq!(order(of_action(&listed("gripper x y z roll pitch yaw"))).unwrap(), [1, 2, 3, 4, 5, 6, 0]);
        assert_eq!(order(of_action(&listed("action_1 action_0"))).unwrap(), [1, 0]);
        for names in ["x y z gripper", "shoulder_pan elbow_flex gripper", "x y z roll pitch roll gripper"] {
            assert_eq!(of_action(&listed(names)), Names::Other, "{names}");
        }
    }
}
