//! The cameras that commands with a simulator may draw.

use rollout::WorkerSpec;

/// Cameras whose images are observed, and their size.
#[derive(clap::Args)]
pub struct CameraArgs {
    /// Cameras to render
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub cameras: Vec<String>,
    /// Side of the images, in pixels
    #[arg(long, visible_alias = "image-size", default_value_t = 84, value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub size: u16,
    /// Draw without reflections and multisampling: a third of the time; policies trained on it are evaluated alike
    #[arg(long, requires = "cameras")]
    pub fast_render: bool,
}

impl CameraArgs {
    /// Has a worker draw what these cameras see.
    pub fn set(&self, spec: &mut WorkerSpec) {
        spec.cameras.clone_from(&self.cameras);
        spec.image_size = usize::from(self.size);
        spec.fast_render = self.fast_render;
    }
}
