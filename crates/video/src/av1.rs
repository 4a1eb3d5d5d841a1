//! AV1 samples to pictures, by rav1d.

use re_rav1d::dav1d::{Decoder, Error, Picture, PixelLayout, PlanarImageComponent, Settings};

use crate::colour::{self, Planes};
use crate::sequence::{self, Sequence};

/// A decoder of one stream, on the thread that calls it.
pub(crate) struct Av1 {
    decoder: Decoder,
    sequence: Sequence,
    /// The header, for streams whose key frames come without one.
    header: Vec<u8>,
}

impl Av1 {
    /// `header` is the unit that `sequence` was read from.
    pub fn new(sequence: Sequence, header: Vec<u8>) -> Result<Self, String> {
        let mut settings = Settings::new();
        settings.set_n_threads(1);
        settings.set_max_frame_delay(1);
        settings.set_all_layers(false);
        settings.set_frame_size_limit(sequence.width.saturating_mul(sequence.height));
        let decoder = Decoder::with_settings(&settings).map_err(|e| e.to_string())?;
        Ok(Self { decoder, sequence, header })
    }

    /// Decodes one sample, which must show one picture, into `out`.
    pub fn decode(&mut self, sample: &[u8], key: bool, out: &mut [u8]) -> Result<(), String> {
        let units = sequence::units(sample).ok_or("a unit reaches beyond the sample")?;
        let mut data = Vec::with_capacity(sample.len() + self.header.len());
        let headers = units.iter().filter(|u| u.kind == sequence::SEQUENCE);
        if key && headers.clone().count() == 0 {
            data.extend_from_slice(&self.header);
        }
        for header in headers {
            if sequence::parse(header.content) != Some(self.sequence) {
                return Err("its sequence header is another than that of the first frame".to_owned());
            }
        }
        if !units.iter().all(sequence::allowed) {
            return Err("it holds a list of tiles".to_owned());
        }
        data.extend_from_slice(sample);
        let mut sent = self.decoder.send_data(data, None, None, None);
        let mut shown = 0;
        loop {
            match self.decoder.get_picture() {
                Ok(picture) => {
                    shown += 1;
                    if shown > 1 {
                        return Err("it shows more than one image".to_owned());
                    }
                    self.take(&picture, out)?;
                }
                Err(Error::Again) if sent == Err(Error::Again) => sent = self.decoder.send_pending_data(),
                Err(Error::Again) => break,
                Err(e) => return Err(e.to_string()),
            }
        }
        match (sent, shown) {
            (Ok(()), 1) => Ok(()),
            (Ok(()), _) => Err("it shows no image".to_owned()),
            (Err(e), _) => Err(e.to_string()),
        }
    }

    fn take(&self, picture: &Picture, out: &mut [u8]) -> Result<(), String> {
        let size = (picture.width(), picture.height());
        if size != (self.sequence.width, self.sequence.height) {
            return Err(format!("an image of {} x {}", size.0, size.1));
        }
        if picture.pixel_layout() != PixelLayout::I420 || picture.bit_depth() != 8 {
            return Err(format!("an image of {:?} with {} bits", picture.pixel_layout(), picture.bit_depth()));
        }
        let planes = [PlanarImageComponent::Y, PlanarImageComponent::U, PlanarImageComponent::V];
        let strides = (picture.stride(planes[0]) as usize, picture.stride(planes[1]) as usize);
        let [y, u, v] = planes.map(|plane| picture.plane(plane));
        let planes = Planes { y: &y, u: &u, v: &v, strides };
        match colour::to_rgb(&planes, size.0 as usize, size.1 as usize, out) {
            true => Ok(()),
            false => Err("planes that are too small".to_owned()),
        }
    }
}
