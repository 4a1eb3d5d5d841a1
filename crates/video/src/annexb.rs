//! H.264 as an encoder streams it (Annex B of the standard), as the samples of a file.

use crate::Sample;

const SLICE_IDR: u8 = 5;
const SUPPLEMENT: u8 = 6;
const SEQUENCE: u8 = 7;
const PICTURE: u8 = 8;
const DELIMITER: u8 = 9;

/// The samples of a stream whose pictures begin with access unit delimiters and lie in the order in which they are shown;
/// `None` where the bytes are no such stream.
pub(crate) fn samples(stream: &[u8]) -> Option<Vec<Sample>> {
    let mut samples: Vec<Sample> = Vec::new();
    let (mut sequence, mut picture): (&[u8], &[u8]) = (&[], &[]);
    for unit in units(stream) {
        let kind = unit.first()? & 0x1f;
        if kind == DELIMITER {
            samples.push(Sample { bytes: Vec::new(), key: false, parameters: Vec::new() });
            continue;
        }
        match kind {
            // a file has the parameters once, and no need of the encoder's name
            SEQUENCE => sequence = unit,
            PICTURE => picture = unit,
            SUPPLEMENT => {}
            _ => {
                let sample = samples.last_mut()?;
                sample.bytes.extend(u32::try_from(unit.len()).ok()?.to_be_bytes());
                sample.bytes.extend_from_slice(unit);
                if kind == SLICE_IDR && !sample.key {
                    sample.key = true;
                    sample.parameters = parameters(sequence, picture)?;
                }
            }
        }
    }
    samples.iter().all(|sample| !sample.bytes.is_empty()).then_some(samples)
}

/// The content of box `avcC`: units have four bytes of length before them.
fn parameters(sequence: &[u8], picture: &[u8]) -> Option<Vec<u8>> {
    let &[profile, compatible, level] = sequence.get(1..4)? else { return None };
    let mut config = vec![1, profile, compatible, level, 0xff, 0xe1];
    config.extend(u16::try_from(sequence.len()).ok()?.to_be_bytes());
    config.extend_from_slice(sequence);
    config.push(1);
    config.extend(u16::try_from(picture.len()).ok().filter(|&length| length > 0)?.to_be_bytes());
    config.extend_from_slice(picture);
    if matches!(profile, 100 | 110 | 122 | 144) {
        // 4:2:0, 8 bits of both, no more sets
        config.extend([0xfd, 0xf8, 0xf8, 0]);
    }
    Some(config)
}

/// The units of a stream, each of which begins with the bytes 0, 0, 1.
fn units(stream: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut starts = Vec::new();
    let mut at = 0;
    while at + 3 <= stream.len() {
        match stream[at..at + 3] {
            [0, 0, 1] => {
                starts.push(at);
                at += 3;
            }
            _ => at += 1,
        }
    }
    let ends: Vec<usize> = starts.iter().skip(1).copied().chain([stream.len()]).collect();
    starts.into_iter().zip(ends).map(|(from, to)| {
        // zeros before the next one belong to its beginning
        let unit = &stream[from + 3..to];
        &unit[..unit.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1)]
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_stream_is_cut_at_its_delimiters() {
        let stream = [
            &[0, 0, 0, 1, 9, 0x10][..],
            &[0, 0, 0, 1, 0x67, 66, 0, 30, 0xab],
            &[0, 0, 1, 0x68, 0xce],
            &[0, 0, 1, 6, 5, 5],
            &[0, 0, 1, 0x65, 0, 0, 3, 1],
            &[0, 0, 0, 1, 9, 0x30],
            &[0, 0, 1, 0x41, 7],
        ]
        .concat();
        let samples = samples(&stream).unwrap();
        let parameters =
            [&[1, 66, 0, 30, 0xff, 0xe1, 0, 5, 0x67, 66, 0, 30, 0xab][..], &[1, 0, 2, 0x68, 0xce]].concat();
        let first = Sample { bytes: vec![0, 0, 0, 5, 0x65, 0, 0, 3, 1], key: true, parameters };
        let second = Sample { bytes: vec![0, 0, 0, 2, 0x41, 7], key: false, parameters: Vec::new() };
        assert_eq!(samples, [first, second]);
    }

    #[test]
    fn what_is_no_stream_has_no_samples() {
        assert_eq!(samples(b"").unwrap(), []);
        // a slice before any delimiter, a picture without a slice, a key picture without parameters
        for bad in [&[0, 0, 1, 0x41, 7][..], &[0, 0, 1, 9, 0x10, 0, 0, 1, 6, 5], &[0, 0, 1, 9, 0x10, 0, 0, 1, 0x65, 7]]
        {
            assert_eq!(samples(bad), None, "{bad:?}");
        }
    }
}
