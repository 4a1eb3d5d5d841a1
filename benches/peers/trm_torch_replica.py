"""Times one TRM supervision step (forward, loss, backward) in PyTorch, or writes a folder for the parity test.

A replica of the official model's maths
(SamsungSAILMontreal/TinyRecursiveModels, models/recursive_reasoning/trm.py), not
the official code: given the official weights it returns the official outputs to the bit on the machine that made the
fixtures, and it makes the same tensor operations, so it stands in for the official code where that cannot be installed.

    python benches/peers/trm_torch_replica.py --threads 1 --mixing attention --repeats 5

prints one JSON line with the smallest and median wall and CPU seconds of a step;

    python benches/peers/trm_torch_replica.py --fixture DIR --seed 7 --hidden 48 --heads 4 --length 20 --layers 1

writes DIR/config.json, model.safetensors (the official names) and io.safetensors (four supervision steps): with
ACTRM_PARITY_DIR=DIR, `cargo test -p solvers --test trm_parity` holds our model to it.
"""

import argparse
import json
import math
import statistics
import time
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file


def rms_norm(x: torch.Tensor) -> torch.Tensor:
    x = x.to(torch.float32)
    return x * torch.rsqrt(x.square().mean(-1, keepdim=True) + 1e-5)


def rotate_half(x: torch.Tensor) -> torch.Tensor:
    half = x.shape[-1] // 2
    return torch.cat((-x[..., half:], x[..., :half]), dim=-1)


class SwiGLU(torch.nn.Module):
    def __init__(self, size: int) -> None:
        super().__init__()
        inner = -(-round(4 * size * 2 / 3) // 256) * 256
        self.gate_up = torch.nn.Linear(size, 2 * inner, bias=False)
        self.down = torch.nn.Linear(inner, size, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        gate, up = self.gate_up(x).chunk(2, dim=-1)
        return self.down(F.silu(gate) * up)


class Attention(torch.nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = torch.nn.Linear(dim, 3 * dim, bias=False)
        self.out = torch.nn.Linear(dim, dim, bias=False)

    def forward(self, x: torch.Tensor, cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
        batch, length, dim = x.shape
        qkv = self.qkv(x).view(batch, length, 3 * self.heads, dim // self.heads)
        q, k, v = qkv.split(self.heads, dim=2)
        q = q * cos[:, None] + rotate_half(q) * sin[:, None]
        k = k * cos[:, None] + rotate_half(k) * sin[:, None]
        q, k, v = (t.transpose(1, 2) for t in (q, k, v))
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(batch, length, dim)
        return self.out(mixed)


class Convolution(torch.nn.Module):
    """Our third mixing, for comparison: the official model has no such thing."""

    def __init__(self, dim: int, side: int) -> None:
        super().__init__()
        self.side = side
        self.conv = torch.nn.Conv2d(dim, dim, 3, padding=1, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        grid = x.transpose(1, 2).unflatten(2, (self.side, self.side))
        return self.conv(grid).flatten(2).transpose(1, 2)


class Layer(torch.nn.Module):
    def __init__(self, dim: int, heads: int, length: int, mixing: str) -> None:
        super().__init__()
        self.mixing = mixing
        if mixing == "attention":
            self.mix = Attention(dim, heads)
        elif mixing == "mlp_t":
            self.mix = SwiGLU(length)
        else:
            self.mix = Convolution(dim, math.isqrt(length))
        self.mlp = SwiGLU(dim)

    def forward(self, x: torch.Tensor, cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
        if self.mixing == "attention":
            x = rms_norm(x + self.mix(x, cos, sin))
        elif self.mixing == "conv":
            x = rms_norm(x + self.mix(x))
        else:
            x = x.transpose(1, 2)
            x = rms_norm(x + self.mix(x)).transpose(1, 2)
        return rms_norm(x + self.mlp(x))


class Trm(torch.nn.Module):
    def __init__(self, args: argparse.Namespace) -> None:
        super().__init__()
        self.args = args
        self.embed = torch.nn.Embedding(args.vocab, args.hidden)
        self.layers = torch.nn.ModuleList(
            Layer(args.hidden, args.heads, args.length, args.mixing) for _ in range(args.layers)
        )
        self.lm_head = torch.nn.Linear(args.hidden, args.vocab, bias=False)
        self.q_head = torch.nn.Linear(args.hidden, 2)
        size = args.hidden // args.heads
        frequencies = 1.0 / (1e4 ** (torch.arange(0, size, 2, dtype=torch.float32) / size))
        angles = torch.outer(torch.arange(args.length, dtype=torch.float32), frequencies)
        angles = torch.cat((angles, angles), dim=-1)
        self.cos, self.sin = angles.cos(), angles.sin()

    def network(self, x: torch.Tensor, injected: torch.Tensor) -> torch.Tensor:
        x = x + injected
        for layer in self.layers:
            x = layer(x, self.cos, self.sin)
        return x

    def round(self, z_h: torch.Tensor, z_l: torch.Tensor, e: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        for _ in range(self.args.l_cycles):
            z_l = self.network(z_l, z_h + e)
        return self.network(z_h, z_l), z_l

    def states(self, z_h: torch.Tensor, z_l: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        e = math.sqrt(self.args.hidden) * self.embed(x)
        with torch.no_grad():
            for _ in range(self.args.h_cycles - 1):
                z_h, z_l = self.round(z_h, z_l, e)
        return self.round(z_h, z_l, e)

    def read(self, z_h: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.lm_head(z_h), self.q_head(z_h[:, 0])[:, 0]

    def forward(self, z_h: torch.Tensor, z_l: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.read(self.states(z_h, z_l, x)[0])


def stablemax_cross_entropy(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    x = logits.to(torch.float64)
    s = torch.where(x < 0, 1 / (1 - x + 1e-30), x + 1)
    log_p = torch.log(s / s.sum(-1, keepdim=True))
    return -log_p.gather(-1, labels.unsqueeze(-1)).squeeze(-1)


def official_name(name: str) -> str:
    """The official checkpoint's name of one of our parameters."""
    if name == "embed.weight":
        return "inner.embed_tokens.embedding_weight"
    if not name.startswith("layers."):
        return f"inner.{name}"
    _, layer, module, part, _ = name.split(".")
    parts = {"qkv": "qkv_proj", "out": "o_proj", "gate_up": "gate_up_proj", "down": "down_proj"}
    mix = "self_attn" if part in ("qkv", "out") else "mlp_t"
    return f"inner.L_level.layers.{layer}.{mix if module == 'mix' else module}.{parts[part]}.weight"


@torch.no_grad()
def write_fixture(model: Trm, args: argparse.Namespace, folder: Path) -> None:
    """A model with random weights, and what it answers over four supervision steps."""
    folder.mkdir(parents=True, exist_ok=True)
    config: dict[str, object] = {
        "batch_size": args.batch, "seq_len": args.length, "vocab_size": args.vocab, "hidden_size": args.hidden,
        "num_heads": args.heads, "H_cycles": args.h_cycles, "L_cycles": args.l_cycles, "L_layers": args.layers,
        "halt_max_steps": 16,
    }  # fmt: skip
    if args.mixing == "mlp_t":
        config |= {"mlp_t": True, "pos_encodings": "none"}
    weights = {official_name(name): tensor.contiguous() for name, tensor in model.state_dict().items()}
    x = torch.randint(0, args.vocab, (args.batch, args.length))
    io = {"inputs": x}
    states: list[torch.Tensor] = []
    for name in ("H_init", "L_init"):
        weights[f"inner.{name}"] = torch.randn(args.hidden).clamp(-2, 2)
        states.append(weights[f"inner.{name}"].expand(args.batch, args.length, args.hidden))
    z_h, z_l = states
    for step in range(4):
        z_h, z_l = model.states(z_h, z_l, x)
        logits, q = model.read(z_h)
        outputs = {"logits": logits, "q_halt_logits": q, "z_h": z_h, "z_l": z_l}
        io |= {f"step{step}.{name}": tensor.contiguous() for name, tensor in outputs.items()}
    (folder / "config.json").write_text(json.dumps(config, indent=1))
    save_file(weights, folder / "model.safetensors")
    save_file(io, folder / "io.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in [
        ("threads", 1), ("hidden", 64), ("heads", 8), ("layers", 2), ("length", 81), ("vocab", 11), ("batch", 64),
        ("h-cycles", 3), ("l-cycles", 6), ("repeats", 5), ("seed", 0),
    ]:  # fmt: skip
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--mixing", choices=["attention", "mlp_t", "conv"], default="attention")
    parser.add_argument("--fixture", type=Path, help="folder to write for the parity test, instead of timing")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    model = Trm(args)
    if args.fixture is not None:
        write_fixture(model, args, args.fixture)
        return
    x = torch.randint(0, args.vocab, (args.batch, args.length))
    labels = torch.randint(0, args.vocab, (args.batch, args.length))
    z = torch.randn(args.hidden).expand(args.batch, args.length, args.hidden)
    wall, cpu = [], []
    for repeat in range(args.repeats + 1):
        begun = (time.perf_counter(), time.process_time())
        logits, q = model(z, z, x)
        loss = stablemax_cross_entropy(logits, labels).mean(-1).sum()
        solved = (logits.argmax(-1) == labels).all(-1).to(torch.float32)
        loss = loss + 0.5 * F.binary_cross_entropy_with_logits(q, solved, reduction="sum")
        model.zero_grad(set_to_none=True)
        (loss / args.batch).backward()
        if repeat > 0:
            wall.append(time.perf_counter() - begun[0])
            cpu.append(time.process_time() - begun[1])
    result = {
        "work": "trm supervision step", "peer": "torch replica of the official TRM", "torch": torch.__version__,
        "mixing": args.mixing, "threads": args.threads, "batch": args.batch,
        "wall_min": min(wall), "wall_median": statistics.median(wall),
        "cpu_min": min(cpu), "cpu_median": statistics.median(cpu),
    }  # fmt: skip
    print(json.dumps(result))


if __name__ == "__main__":
    main()
