//! How large a model will be: held to the models themselves.

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::{FeatureSpec, PolicyConfig, Signature};

    fn config(kind: &str, keys: serde_json::Value) -> PolicyConfig {
        let mut keys = keys;
        keys["type"] = kind.into();
        serde_json::from_value(keys).unwrap()
    }

    #[test]
    fn the_size_told_is_below_the_real_one_and_near_it() {
        let observation = vec![FeatureSpec::state(9), FeatureSpec::environment_state(10)];
        let signature = Signature { observation, action_dim: 7, ..Signature::default() };
        let wide = serde_json::json!({"dim_model": 128, "n_heads": 4, "dim_feedforward": 256, "action_horizon": 16});
        let deep = serde_json::json!({"dim_model": 32, "n_heads": 4, "dim_feedforward": 64, "action_horizon": 100});
        let long = |keys: serde_json::Value| {
            let mut all =
                serde_json::json!({"dim_model": 128, "n_heads": 4, "dim_feedforward": 256, "action_horizon": 900});
            all.as_object_mut().unwrap().extend(keys.as_object().unwrap().clone());
            all
        };
        let (vae, plain_long) = (long(serde_json::json!({})), long(serde_json::json!({"use_vae": false})));
        let over = [("memory", 900), ("memory", 20), ("tokens", 200)]
            .map(|(over, hidden)| long(serde_json::json!({"reasoning": {"over": over, "dim_feedforward": hidden}})));
        let untied = long(serde_json::json!({"use_vae": false, "reasoning": {"untied": true}}));
        let layers = serde_json::json!({"hidden": [1024, 1024], "action_horizon": 16});
        let plain = serde_json::json!({});
        let levels = serde_json::json!({"network": {"down_dims": [32, 64, 128]}});
        let tokens = serde_json::json!({"transformer": {"dim_model": 64, "n_layers": 3}});
        let encoded = serde_json::json!({"transformer": {"dim_model": 64, "n_layers": 1, "n_encoder_layers": 4}});
        let recurrent = serde_json::json!({"action_horizon": 1, "hidden_dim": 64});
        let shallow = serde_json::json!({"dim_model": 64, "n_layers": 2});
        for kind in PolicyConfig::TYPES {
            let tried = match *kind {
                "act" => vec![&wide, &deep, &vae, &plain_long],
                "actrm" => [&wide, &deep, &vae, &plain_long, &untied].into_iter().chain(&over).collect(),
                "bc" => vec![&layers],
                "bc_rnn" => vec![&recurrent],
                "bc_transformer" => vec![&shallow],
                "diffusion" => vec![&levels, &tokens],
                "flow" | "mip" => vec![&levels, &encoded],
                _ => vec![&plain],
            };
            for keys in tried {
                let config = config(kind, keys.clone());
                let told = config.size().weights;
                let model = config.build(&signature, 1, &nn::Backend::CPU).unwrap();
                let real = model.params().count() as f64;
                config.check_size(&model.params().tensors()).unwrap();
                assert!(0.5 * real <= told && told <= real, "{kind} {keys}: {told} of {real}");
            }
        }
    }

    #[test]
    fn options_of_a_far_larger_model_are_refused() {
        let signature = Signature::low_dimensional(9, 10, 7);
        let keys = serde_json::json!({"dim_model": 32, "n_heads": 4, "dim_feedforward": 64, "action_horizon": 8});
        let model = config("act", keys.clone()).build(&signature, 1, &nn::Backend::CPU).unwrap();
        let mut larger = keys;
        larger["dim_feedforward"] = 1_000_000_u64.into();
        let error = config("act", larger).check_size(&model.params().tensors()).unwrap_err().to_string();
        assert!(error.contains("numbers") && error.contains("as the options say"), "{error}");
    }

    #[test]
    fn absurd_options_have_absurd_sizes() {
        let bytes = |keys, samples| config("act", keys).size().training_bytes(samples);
        assert!(bytes(serde_json::json!({}), 64) < 8e9);
        assert!(bytes(serde_json::json!({}), 100_000_000) > 1e14);
        for (key, value) in
            [("dim_model", 1_000_000_000_u64), ("n_encoder_layers", 100_000), ("action_horizon", 1_000_000_000)]
        {
            let mut keys = serde_json::json!({});
            keys[key] = value.into();
            assert!(bytes(keys, 64) > 1e12, "{key}");
        }
    }
}
