//! Boxes of an MP4 file and the fields in them: every length is checked before it is used.

use crate::error::{Result, VideoError};

/// Four letters.
pub(crate) type Kind = [u8; 4];

/// A kind of box or codec as it is printed.
pub(crate) fn name_of(kind: Kind) -> String {
    kind.iter().map(|&b| if b.is_ascii_graphic() || b == b' ' { char::from(b) } else { '?' }).collect()
}

/// The error for a box that is not as it must be.
pub(crate) fn bad_box(name: &str, kind: &str, expected: impl Into<String>, found: impl Into<String>) -> VideoError {
    VideoError::Malformed {
        name: name.to_owned(),
        object: format!("box {kind}"),
        expected: expected.into(),
        found: found.into(),
    }
}

/// Fields one after the other; `None` where there are no more bytes.
#[derive(Clone, Copy)]
pub(crate) struct Fields<'a>(pub &'a [u8]);

impl<'a> Fields<'a> {
    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(head)
    }

    pub fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.take(N)?.try_into().ok()
    }

    pub fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[b]| b)
    }

    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_be_bytes)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_be_bytes)
    }

    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_be_bytes)
    }

    /// Version and flags of a full box; the version.
    pub fn version(&mut self) -> Option<u8> {
        self.array::<4>().map(|[version, ..]| version)
    }
}

/// The boxes in `data`, which is the content of box `parent`, in order.
pub(crate) struct Children<'a> {
    name: &'a str,
    parent: &'a str,
    rest: Fields<'a>,
}

/// The boxes inside the content of box `parent`.
pub(crate) fn children<'a>(name: &'a str, parent: &'a str, data: &'a [u8]) -> Children<'a> {
    Children { name, parent, rest: Fields(data) }
}

impl<'a> Iterator for Children<'a> {
    type Item = Result<(Kind, &'a [u8])>;

    fn next(&mut self) -> Option<Self::Item> {
        // up to seven bytes of filling may follow the last box
        if self.rest.0.len() < 8 {
            return None;
        }
        let all = self.rest;
        let taken = take_box(&mut self.rest);
        if taken.is_none() {
            self.rest.0 = &[];
            let found = format!("{} bytes that are no box", all.0.len());
            return Some(Err(bad_box(self.name, self.parent, "boxes that lie inside it", found)));
        }
        taken.map(Ok)
    }
}

fn take_box<'a>(rest: &mut Fields<'a>) -> Option<(Kind, &'a [u8])> {
    let whole = rest.0.len() as u64;
    let size = u64::from(rest.u32()?);
    let kind = rest.array()?;
    let (size, head) = match size {
        0 => (whole, 8),
        1 => (rest.u64()?, 16),
        n => (n, 8),
    };
    let content = usize::try_from(size.checked_sub(head)?).ok()?;
    Some((kind, rest.take(content)?))
}

/// The first child of a kind.
pub(crate) fn child<'a>(name: &'a str, parent: &'a str, data: &'a [u8], kind: Kind) -> Result<Option<&'a [u8]>> {
    for found in children(name, parent, data) {
        let (this, content) = found?;
        if this == kind {
            return Ok(Some(content));
        }
    }
    Ok(None)
}

/// The first child of a kind, which must be there.
pub(crate) fn needed<'a>(name: &'a str, parent: &'a str, data: &'a [u8], kind: Kind) -> Result<&'a [u8]> {
    child(name, parent, data, kind)?
        .ok_or_else(|| bad_box(name, parent, format!("a box {} in it", name_of(kind)), "none"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn boxed(kind: &[u8; 4], content: &[u8]) -> Vec<u8> {
        [&(content.len() as u32 + 8).to_be_bytes()[..], kind, content].concat()
    }

    #[test]
    fn boxes_come_in_order_and_none_reaches_beyond_its_parent() {
        let mut data = [boxed(b"aaaa", &[1, 2]), boxed(b"bbbb", &[])].concat();
        data.extend([0, 0, 0]);
        let found: Vec<_> = children("f", "moov", &data).map(|b| b.unwrap()).collect();
        assert_eq!(found, [(*b"aaaa", &[1_u8, 2][..]), (*b"bbbb", &[][..])]);
        assert_eq!(needed("f", "moov", &data, *b"aaaa").unwrap(), [1, 2]);
        let text = needed("f", "moov", &data, *b"cc\0c").unwrap_err().to_string();
        assert_eq!(text, "f: damaged: box moov: expected a box cc?c in it, found none");
        for size in [7_u32, 11, u32::MAX] {
            let mut bad = boxed(b"aaaa", &[1, 2]);
            bad[..4].copy_from_slice(&size.to_be_bytes());
            assert!(children("f", "moov", &bad).next().unwrap().is_err(), "{size}");
        }
        // sizes of 64 bits, the largest included
        let long = [&1_u32.to_be_bytes()[..], b"aaaa", &18_u64.to_be_bytes(), &[5, 6]].concat();
        assert_eq!(children("f", "moov", &long).next().unwrap().unwrap().1, [5, 6]);
        for size in [15_u64, 19, u64::MAX] {
            let mut bad = long.clone();
            bad[8..16].copy_from_slice(&size.to_be_bytes());
            assert!(children("f", "moov", &bad).next().unwrap().is_err(), "{size}");
        }
    }
}
