//! The VAE encoder of an action chunk, its sample and its KL term.

use super::{Data, Encoder, Grads, Pass, slot};
use nn::kernels::add;

/// Sizes of the encoder, and its fixed positions.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Vae<'a> {
    pub(crate) n_layers: usize,
    pub(crate) latent_dim: usize,
    /// (H + 2, D)
    pub(crate) positions: &'a [f32],
}

/// What its backward pass needs.
#[derive(Debug)]
pub(crate) struct Encoded {
    encoder: Encoder,
    /// the first token, (b, D)
    cls: Vec<f32>,
    /// mean and log-variance, (b, 2L)
    latent: Vec<f32>,
    /// the noise of the sample, (b, L)
    eps: Vec<f32>,
}

impl Vae<'_> {
    /// Encodes tokens `[cls, state, actions…]`. Of the last layer only the first token is computed, because nothing
    /// else of it is read. `eps` gives the noise, (b, L); returns the sample, (b, L).
    pub(crate) fn forward(
        &self,
        pass: &mut Pass<'_>,
        data: &Data,
        eps: impl FnOnce(&mut Pass<'_>) -> Vec<f32>,
    ) -> (Vec<f32>, Encoded) {
        let (b, dim) = (data.rows, pass.shape.dim);
        let tokens = self.positions.len() / dim;
        let horizon = tokens - 2;
        let cls = pass.weight("vae_encoder_cls_embed", ".weight");
        let state = pass.linear("vae_encoder_robot_state_input_proj", data.state());
        let actions = pass.linear("vae_encoder_action_input_proj", &data.actions);
        let mut x = pass.take(b * tokens * dim);
        let mut key_pad = pass.space.pool.zeros(b * tokens);
        for i in 0..b {
            let x = &mut x[i * tokens * dim..(i + 1) * tokens * dim];
            x[..dim].copy_from_slice(cls);
            x[dim..2 * dim].copy_from_slice(&state[i * dim..(i + 1) * dim]);
            x[2 * dim..].copy_from_slice(&actions[i * horizon * dim..(i + 1) * horizon * dim]);
            key_pad[i * tokens + 2..(i + 1) * tokens].copy_from_slice(&data.is_pad[i * horizon..(i + 1) * horizon]);
        }
        pass.give(state);
        pass.give(actions);
        let (cls, encoder) =
            Encoder::forward(pass, "vae_encoder", self.n_layers, x, self.positions, Some(&key_pad), true);
        pass.give(key_pad);
        let latent = pass.linear("vae_encoder_latent_output_proj", &cls);
        let eps = eps(pass);
        let width = self.latent_dim;
        let mut sample = pass.take(b * width);
        let rows = sample.chunks_exact_mut(width).zip(latent.chunks_exact(2 * width)).zip(eps.chunks_exact(width));
        for ((z, out), eps) in rows {
            let (mu, log_variance) = out.split_at(width);
            for (((z, mu), lv), eps) in z.iter_mut().zip(mu).zip(log_variance).zip(eps) {
                *z = mu + (lv / 2.0).exp() * eps;
            }
        }
        (sample, Encoded { encoder, cls, latent, eps })
    }

    /// Takes the gradient of the sample, (b, L), adds that of `kl_weight` times KL(latent ‖ N(0, 1)), averaged over the
    /// rows of the whole batch, and returns the KL term without its weight.
    #[allow(clippy::needless_range_loop)] // mean and log-variance lie side by side in one row
    pub(crate) fn backward(
        &self,
        pass: &mut Pass<'_>,
        data: &Data,
        done: Encoded,
        sample_grad: &[f32],
        kl_weight: f64,
        grads: &mut Grads<'_>,
    ) -> f32 {
        let Encoded { encoder, cls, latent, eps } = done;
        let (b, dim, width) = (data.rows, pass.shape.dim, self.latent_dim);
        let tokens = self.positions.len() / dim;
        let horizon = tokens - 2;
        let (weight, rows) = (kl_weight as f32, data.total_rows as f32);
        let mut kld = 0.0f64;
        let mut grad = pass.take(latent.len());
        for (i, (grad, out)) in grad.chunks_exact_mut(2 * width).zip(latent.chunks_exact(2 * width)).enumerate() {
            for j in 0..width {
                let (mu, lv) = (out[j], out[width + j]);
                let (through, eps) = (sample_grad[i * width + j], eps[i * width + j]);
                kld -= 0.5 * f64::from(1.0 + lv - mu * mu - lv.exp());
                grad[j] = through + weight * mu / rows;
                grad[width + j] = through * eps * 0.5 * (lv / 2.0).exp() + weight * 0.5 * (lv.exp() - 1.0) / rows;
            }
        }

        pass.linear_backward("vae_encoder_latent_output_proj", &cls, &grad, dim, grads);
        let x = pass.linear_input("vae_encoder_latent_output_proj", &grad, dim);
        let x = encoder.backward(pass, x, self.positions, None, grads);
        let (mut state, mut actions) = (pass.take(b * dim), pass.take(b * horizon * dim));
        for i in 0..b {
            let x = &x[i * tokens * dim..(i + 1) * tokens * dim];
            add(slot(grads, "vae_encoder_cls_embed", ".weight"), &x[..dim]);
            state[i * dim..(i + 1) * dim].copy_from_slice(&x[dim..2 * dim]);
            actions[i * horizon * dim..(i + 1) * horizon * dim].copy_from_slice(&x[2 * dim..]);
        }
        pass.linear_backward("vae_encoder_robot_state_input_proj", data.state(), &state, data.state().len() / b, grads);
        pass.linear_backward(
            "vae_encoder_action_input_proj",
            &data.actions,
            &actions,
            data.actions.len() / (b * horizon),
            grads,
        );
        for buffer in [state, actions, x, cls, latent, grad] {
            pass.give(buffer);
        }
        (kld / f64::from(rows)) as f32
    }
}
