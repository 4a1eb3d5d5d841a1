//! Lists of observation keys, as experiments and conversions name them.
//!
//! An item of a list is a key (`cube_pos`), a part of one (`goal_rgb[0:3]`), either as it was at the first step of the
//! episode (`first(goal_rgb)`, `first(goal_rgb)[0:3]`: what is remembered) or some control steps before
//! (`before(robot0_gripper_qpos:8)`; at the first step where the episode had not begun yet), the axes of an orientation
//! (`axes(cube_quat)`: a quaternion x, y, z, w as the first two columns of its matrix, six numbers that do not jump
//! where a quaternion changes its sign; Zhou et al. 2019), or the difference of two of those
//! (`cube_pos - robot0_eef_pos`). The same item gives the same numbers whether it is read out of a file or out of a
//! simulator: values become f32 first.

use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

/// When a key is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// at the step that is asked about
    Now,
    /// at the first step of its episode
    First,
    /// so many control steps before, or at the first step of its episode where that is later
    Before(usize),
}

impl Moment {
    /// The step of the episode that is read, where `now` is asked about.
    pub fn step(self, now: usize) -> usize {
        match self {
            Self::Now => now,
            Self::First => 0,
            Self::Before(steps) => now.saturating_sub(steps),
        }
    }
}

/// What is read as a key at an earlier step, in errors.
const BEFORE: &str = "before(key:steps) or before(key:steps)[from:to] with steps of at least 1";

/// A key, or some of its numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Term {
    key: String,
    moment: Moment,
    /// the numbers from the first to before the second
    range: Option<(usize, usize)>,
    /// whether those are a quaternion of which the axes are taken
    axes: bool,
}

impl Term {
    fn parse(text: &str) -> Result<Self, String> {
        let text = text.trim();
        if let Some(inside) = text.strip_prefix("axes(").and_then(|rest| rest.strip_suffix(')')) {
            let inner = Self::parse(inside).ok().filter(|term| !term.axes);
            return Ok(Self { axes: true, ..inner.ok_or("axes(key), of a quaternion")? });
        }
        if let Some((key, rest)) = text.strip_prefix("first(").and_then(|inside| inside.split_once(')')) {
            let term = Self::plain(key, rest).ok_or("first(key) or first(key)[from:to]")??;
            return Ok(Self { moment: Moment::First, ..term });
        }
        if let Some((inside, rest)) = text.strip_prefix("before(").and_then(|inside| inside.split_once(')')) {
            let parts = inside.rsplit_once(':').and_then(|(key, steps)| Some((key, steps.trim().parse().ok()?)));
            let (key, steps) = parts.filter(|&(_, steps)| steps > 0).ok_or(BEFORE)?;
            return Ok(Self { moment: Moment::Before(steps), ..Self::plain(key, rest).ok_or(BEFORE)?? });
        }
        let moment = Moment::Now;
        let Some(open) = text.find('[') else {
            let good = !text.is_empty() && !text.contains([']', '(', ')']);
            return good
                .then(|| Self { key: text.to_owned(), moment, range: None, axes: false })
                .ok_or_else(|| "a key".to_owned());
        };
        let range = text[open + 1..].strip_suffix(']').and_then(|inside| inside.split_once(':'));
        let numbers = range.and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
        match numbers {
            Some((from, to)) if from < to && open > 0 => {
                Ok(Self { key: text[..open].to_owned(), moment, range: Some((from, to)), axes: false })
            }
            _ => Err("key[from:to] with from below to".to_owned()),
        }
    }

    /// A key without a moment and what stands behind it, which is read as behind any other key; `None` if it is no such key.
    fn plain(key: &str, rest: &str) -> Option<Result<Self, String>> {
        let plain = !key.is_empty() && !key.contains(['(', '[', ']']) && (rest.is_empty() || rest.starts_with('['));
        plain.then(|| Self::parse(&format!("{key}{rest}")))
    }

    /// The key with when it is read, without the part.
    fn whole(&self) -> Cow<'_, str> {
        match self.moment {
            Moment::Now => Cow::Borrowed(&self.key),
            Moment::First => Cow::Owned(format!("first({})", self.key)),
            Moment::Before(steps) => Cow::Owned(format!("before({}:{steps})", self.key)),
        }
    }

    fn width(&self, of_key: usize) -> Result<usize, String> {
        let width = match self.range {
            None => of_key,
            Some((from, to)) if to <= of_key => to - from,
            Some(_) => return Err(format!("{self}: {} has {of_key} numbers", self.key)),
        };
        match self.axes {
            false => Ok(width),
            true if width == 4 => Ok(6),
            true => Err(format!("{self}: a quaternion has 4 numbers, this has {width}")),
        }
    }

    fn of<'v>(&self, values: &'v [f32]) -> Cow<'v, [f32]> {
        let part = match self.range {
            None => values,
            Some((from, to)) => &values[from..to],
        };
        match *part {
            [x, y, z, w] if self.axes => Cow::Owned(axes([x, y, z, w]).to_vec()),
            _ => Cow::Borrowed(part),
        }
    }
}

/// The first two columns of the matrix of a quaternion x, y, z, w, one after the other; zeros of one without length.
fn axes(quaternion: [f32; 4]) -> [f32; 6] {
    let [x, y, z, w] = quaternion;
    let squared = x * x + y * y + z * z + w * w;
    let s = if squared > 0.0 { 2.0 / squared } else { return [0.0; 6] };
    [
        1.0 - s * (y * y + z * z),
        s * (x * y + z * w),
        s * (x * z - y * w),
        s * (x * y - z * w),
        1.0 - s * (x * x + z * z),
        s * (y * z + x * w),
    ]
}

impl fmt::Display for Term {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (before, behind) = if self.axes { ("axes(", ")") } else { ("", "") };
        match self.range {
            None => write!(f, "{before}{}{behind}", self.whole()),
            Some((from, to)) => write!(f, "{before}{}[{from}:{to}]{behind}", self.whole()),
        }
    }
}

/// One item of a list of observation keys.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct KeyItem {
    plus: Term,
    minus: Option<Term>,
}

impl KeyItem {
    /// The keys that it reads.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        std::iter::once(&self.plus).chain(&self.minus).map(|term| term.key.as_str())
    }

    /// How many numbers it gives, where `width_of` tells how many a key has.
    ///
    /// # Errors
    /// In words: a key or a part that is not there, a difference of unequal lengths.
    pub fn width(&self, width_of: impl Fn(&str) -> Option<usize>) -> Result<usize, String> {
        let width = |term: &Term| term.width(width_of(&term.key).ok_or_else(|| format!("{self}: no {}", term.key))?);
        let plus = width(&self.plus)?;
        match self.minus.as_ref().map(width).transpose()? {
            Some(minus) if minus != plus => Err(format!("{self}: {plus} numbers minus {minus}")),
            _ => Ok(plus),
        }
    }

    /// The keys that it reads at another step than the one that is asked about, and when.
    pub fn remembered(&self) -> impl Iterator<Item = (&str, Moment)> {
        let terms = std::iter::once(&self.plus).chain(&self.minus);
        terms.filter(|term| term.moment != Moment::Now).map(|term| (term.key.as_str(), term.moment))
    }

    /// Appends its numbers to `out`, where `values_of` gives the numbers of a key at a moment; `None`, with nothing appended, if a key
    /// is not there.
    ///
    /// # Panics
    /// If a key has fewer numbers than when the width was asked for.
    pub fn append<'v>(&self, values_of: impl Fn(&str, Moment) -> Option<&'v [f32]>, out: &mut Vec<f32>) -> Option<()> {
        let plus = self.plus.of(values_of(&self.plus.key, self.plus.moment)?);
        match &self.minus {
            None => out.extend_from_slice(&plus),
            Some(minus) => {
                let minus = minus.of(values_of(&minus.key, minus.moment)?);
                out.extend(plus.iter().zip(minus.iter()).map(|(a, b)| a - b));
            }
        }
        Some(())
    }

    /// How many numbers each of `items` has in a column made of them, by the names of the column's numbers; `None` if the
    /// names are not those of such a column.
    pub fn widths(items: &[Self], names: &[String]) -> Option<Vec<usize>> {
        let mut rest = names;
        let mut widths = Vec::with_capacity(items.len());
        for item in items {
            let width = (1..=rest.len()).rev().find(|&width| item.names(width).eq(rest[..width].iter().cloned()))?;
            widths.push(width);
            rest = &rest[width..];
        }
        rest.is_empty().then_some(widths)
    }

    /// Names of its numbers, as a column lists them.
    pub fn names(&self, width: usize) -> impl Iterator<Item = String> {
        // a difference and axes are called by what they are made of, a part by the key and where it is in it
        let (whole, base, from) = match (&self.minus, self.plus.range) {
            (None, Some((from, _))) if !self.plus.axes => (false, self.plus.whole().into_owned(), from),
            _ => (true, self.to_string(), 0),
        };
        (0..width).map(move |i| match width {
            1 if whole => base.clone(),
            _ => format!("{base}_{}", from + i),
        })
    }
}

impl FromStr for KeyItem {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = match text.split_once(" - ") {
            None => Term::parse(text).map(|plus| Self { plus, minus: None }),
            Some((plus, minus)) => {
                Term::parse(plus).and_then(|plus| Ok(Self { plus, minus: Some(Term::parse(minus)?) }))
            }
        };
        parsed.map_err(|expected| format!("`{text}`: expected {expected}"))
    }
}

impl TryFrom<String> for KeyItem {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<KeyItem> for String {
    fn from(item: KeyItem) -> Self {
        item.to_string()
    }
}

impl fmt::Display for KeyItem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.minus {
            None => self.plus.fmt(f),
            Some(minus) => write!(f, "{} - {minus}", self.plus),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn item(text: &str) -> KeyItem {
        text.parse().unwrap()
    }

    fn values(key: &str, moment: Moment) -> Option<&'static [f32]> {
        match key {
            "a" if moment == Moment::First => Some(&[0.5, 0.6, 0.7]),
            "a" if moment == Moment::Before(8) => Some(&[0.8, 0.9, 1.0]),
            "a" => Some(&[1.0, 2.0, 3.0]),
            "b" => Some(&[10.0, 20.0, 30.0, 40.0]),
            "one" => Some(&[7.0]),
            _ => None,
        }
    }

    fn read(text: &str) -> Result<Vec<f32>, String> {
        let item = item(text);
        let width = item.width(|key| values(key, Moment::Now).map(<[f32]>::len))?;
        let mut out = Vec::new();
        item.append(values, &mut out).unwrap();
        assert_eq!((out.len(), item.names(width).count()), (width, width));
        Ok(out)
    }

    #[test]
    fn items_are_keys_parts_and_differences() {
        assert_eq!(read("a").unwrap(), [1.0, 2.0, 3.0]);
        assert_eq!(read("b[1:3]").unwrap(), [20.0, 30.0]);
        assert_eq!(read("b[0:3] - a").unwrap(), [9.0, 18.0, 27.0]);
        assert_eq!(read("a[2:3] - one").unwrap(), [-4.0]);
        assert_eq!(read("first(a)").unwrap(), [0.5, 0.6, 0.7]);
        assert_eq!(read("a[0:2] - first(a)[0:2]").unwrap(), [0.5, 1.4]);
        assert_eq!(read("before(a:8)").unwrap(), [0.8, 0.9, 1.0]);
        assert_eq!(read("before( a: 8 )[1:3]").unwrap(), [0.9, 1.0]);
        let moments = |text: &str| item(text).remembered().map(|(_, moment)| moment).collect::<Vec<_>>();
        assert_eq!(moments("a - first(a)"), [Moment::First]);
        assert_eq!(moments("before(a:3) - before(a:5)"), [Moment::Before(3), Moment::Before(5)]);
        assert!(moments("a").is_empty());
        assert_eq!([Moment::Now, Moment::First, Moment::Before(8)].map(|moment| moment.step(5)), [5, 0, 0]);
        assert_eq!(Moment::Before(3).step(5), 2);
        assert_eq!(item("first(b)[1:3]").keys().collect::<Vec<_>>(), ["b"]);
        assert_eq!(item("b[1:3] - a[0:2]").keys().collect::<Vec<_>>(), ["b", "a"]);
    }

    #[test]
    fn axes_are_those_of_the_quaternion_and_of_its_negative() {
        // a quarter about z, then any other, beside the rotated unit vectors
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let near = |found: [f32; 6], expected: [f32; 6]| found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(axes([0.0, 0.0, half, half]), [0.0, 1.0, 0.0, -1.0, 0.0, 0.0]));
        assert!(near(axes([3.0, 0.0, 0.0, 0.0]), [1.0, 0.0, 0.0, 0.0, -1.0, 0.0]));
        let quaternion = [0.1, -0.7, 0.3, 0.4];
        assert_eq!(axes(quaternion), axes(quaternion.map(|value: f32| -value)));
        let [a, b, c, d, e, f] = axes(quaternion);
        assert!((a * d + b * e + c * f).abs() < 1e-6 && (a * a + b * b + c * c - 1.0).abs() < 1e-6);
        assert_eq!(axes([0.0; 4]), [0.0; 6]);
        // b is 10, 20, 30, 40: read as it is written, in a part and as it began
        let b = axes([10.0, 20.0, 30.0, 40.0]).to_vec();
        assert_eq!((read("axes(b)").unwrap(), read("axes(b[0:4])").unwrap()), (b.clone(), b.clone()));
        assert_eq!(read("axes(b) - axes(b)").unwrap(), [0.0; 6]);
        assert_eq!(read("axes(a)").unwrap_err(), "axes(a): a quaternion has 4 numbers, this has 3");
        assert_eq!(item("axes(first(b)[0:4])").remembered().collect::<Vec<_>>(), [("b", Moment::First)]);
        assert_eq!(item("axes(before(b:2))").remembered().collect::<Vec<_>>(), [("b", Moment::Before(2))]);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        assert_eq!(read("b[2:5]").unwrap_err(), "b[2:5]: b has 4 numbers");
        assert_eq!(read("b - a").unwrap_err(), "b - a: 4 numbers minus 3");
        assert_eq!(read("a - c").unwrap_err(), "a - c: no c");
        for bad in [
            "",
            "a[",
            "a[1]",
            "a[3:3]",
            "[0:2]",
            "a - ",
            "a]",
            "first()",
            "first(a",
            "first(a[0:1])",
            "first(a)b",
            "axes(a",
            "axes()",
            "axes(axes(a))",
            "last(a)",
            "before(a)",
            "before(a:0)",
            "before(a:-1)",
            "before(:3)",
            "before(a[0:1])",
            "before(a[0:1]:2)",
            "before(axes(a):2)",
        ] {
            let message = bad.parse::<KeyItem>().unwrap_err();
            assert!(message.starts_with(&format!("`{bad}`: expected ")), "{message}");
        }
    }

    #[test]
    fn items_are_written_as_they_are_read() {
        for text in [
            "a",
            "b[1:3]",
            "b[0:3] - a",
            "first(a)",
            "b[0:1] - first(a)[1:2]",
            "axes(b)",
            "axes(first(b)[0:4])",
            "a - before(a:8)",
            "axes(before(b:2)[0:4])",
        ] {
            assert_eq!(item(text).to_string(), text);
            assert_eq!(serde_json::from_str::<KeyItem>(&format!("\"{text}\"")).unwrap(), item(text));
        }
        let names = |text: &str, width| item(text).names(width).collect::<Vec<_>>();
        let items = ["a", "one", "b[1:3]", "b[0:3] - a", "a"].map(item);
        let widths = [3, 1, 2, 3, 3];
        let mut listed: Vec<String> = items.iter().zip(widths).flat_map(|(item, width)| item.names(width)).collect();
        assert_eq!(KeyItem::widths(&items, &listed).unwrap(), widths);
        listed[4] = "c_1".to_owned();
        assert_eq!(KeyItem::widths(&items, &listed), None);
        assert_eq!(names("a", 3), ["a_0", "a_1", "a_2"]);
        assert_eq!(names("first(one)", 1), ["first(one)"]);
        assert_eq!(names("first(b)[1:3]", 2), ["first(b)_1", "first(b)_2"]);
        assert_eq!(names("before(b:8)[1:3]", 2), ["before(b:8)_1", "before(b:8)_2"]);
        assert_eq!(names("axes(b[0:4])", 6)[4..], ["axes(b[0:4])_4", "axes(b[0:4])_5"]);
        assert_eq!(names("one", 1), ["one"]);
        assert_eq!(names("b[1:3]", 2), ["b_1", "b_2"]);
        assert_eq!(names("b[1:2]", 1), ["b_1"]);
        assert_eq!(names("a[0:2] - b[2:4]", 2), ["a[0:2] - b[2:4]_0", "a[0:2] - b[2:4]_1"]);
    }
}
