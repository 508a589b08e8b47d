"""Policy("policy.npz")(observation) is the action, or a named tuple that begins with it."""

import math
from collections import namedtuple

import numpy as np

try:
    from scipy.sparse import csr_array
except ImportError:  # NumPy alone computes the same sums by a dense product

    def csr_array(csr, shape):
        dense = np.zeros(shape, np.float32)
        dense[np.repeat(np.arange(shape[0]), np.diff(csr[2])), csr[1]] = csr[0]
        return dense


def windows(n, x, border):  # units, kernel, places, batch
    x = np.pad(x, [(0, 0), *((p, p) for p in n["padding"]), (0, 0)], constant_values=border)
    x = np.lib.stride_tricks.sliding_window_view(x, tuple(n["kernel"]), (1, 2))
    return x[:, :: n["stride"][0], :: n["stride"][1]].transpose(0, 4, 5, 1, 2, 3)


def softplus(x):  # log(1 + exp(x)), which does not overflow
    return np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))


erf = np.vectorize(math.erf, otypes=[np.float32])  # NumPy has none
OPERATIONS = {  # of a node's arrays and its inputs, whose last axis is the batch
    "normalize": lambda n, x: np.clip((x - n["mean"] - n["rest"]) * n["scale"], *n["clip"]),
    "affine": lambda n, x: x * n["scale"] + n["shift"],
    "clip": lambda n, x: np.clip(x, n["low"], n["high"]),
    "relu": lambda n, x: np.maximum(x, 0),
    "leaky_relu": lambda n, x: np.where(x > 0, x, x * n["slope"]),
    "elu": lambda n, x: np.where(x > 0, x, n["slope"] * np.expm1(np.minimum(x, 0))),
    "exp": lambda n, x: np.exp(x),
    "sqrt": lambda n, x: np.sqrt(x),
    "tanh": lambda n, x: np.tanh(x),
    "sigmoid": lambda n, x: 0.5 * np.tanh(0.5 * x) + 0.5,
    "silu": lambda n, x: x * (0.5 * np.tanh(0.5 * x) + 0.5),
    "gelu": lambda n, x: 0.5 * x * (1 + erf(x * 0.5**0.5)),
    "gelu_tanh": lambda n, x: (
        0.5 * x * (1 + np.tanh((2 / np.pi) ** 0.5 * (x + 0.044715 * np.clip(x, -10, 10) ** 3)))
    ),
    "mish": lambda n, x: x * np.tanh(softplus(x)),
    "softplus": lambda n, x: np.where(x > n["threshold"], x, softplus(x)),
    "softsign": lambda n, x: x / (1 + np.abs(x)),
    "hardswish": lambda n, x: x * (np.clip(x + 3, 0, 6) / 6),
    "tanhshrink": lambda n, x: x - np.tanh(x),
    "softshrink": lambda n, x: x - np.clip(x, -n["most"], n["most"]),
    "hardshrink": lambda n, x: np.where(np.abs(x) <= n["most"], 0, x),
    "threshold": lambda n, x: np.where(x <= n["most"], n["instead"], x),
    "linear": lambda n, x: n["weight"] @ x + n["bias"],
    "conv": lambda n, x: (
        n["weight"] @ (w := windows(n, x, 0)).reshape(-1, np.prod(w.shape[3:])) + n["bias"]
    ).reshape(-1, *w.shape[3:]),
    "max_pool": lambda n, x: windows(n, x, -np.inf).max((1, 2)),
    "flatten": lambda n, x: x.reshape(-1, x.shape[-1]),
    "slice": lambda n, x: x[slice(*n["range"])].reshape(*n["shape"], x.shape[-1]),
    "one_hot": lambda n, x: (np.repeat(x, n["sizes"], 0) == n["values"]).astype(np.float32),
    "concat": lambda n, *x: np.concatenate(x),
    "standardize": lambda n, x: (x - x.mean(0)) / np.sqrt(x.var(0) + n["eps"]),
    "add": lambda n, x, y: x + y,
    "multiply": lambda n, x, y: x * y,
    "minimum": lambda n, x, y: np.minimum(x, y),
    "largest": lambda n, x: x.max(0, keepdims=True),
    "constant": lambda n, x: np.repeat(n["numbers"], x.shape[-1], -1),
    "argmax": lambda n, x: np.stack([p.argmax(0) for p in np.split(x, n["splits"])]),
    "positive": lambda n, x: (x > 0).astype(np.int64),
}


class Policy:  # takes one observation, or many: one a row; or a dict of them
    def __init__(self, path):
        with np.load(path) as file:
            self.shape, self.nodes = file["observation"], []
            names = file["outputs"].tolist() if "outputs" in file else []
            self.outputs = [(file[f"value.{n}"], file[f"shape.{n}"]) for n in names]
            self.outputs = self.outputs or [(-1, file["action"])]
            self.named = namedtuple("Outputs", names) if names else lambda action: action
            self.parts = list(zip(file["keys"], file["axes"]))
            for i, (op, inputs) in enumerate(zip(file["ops"], file["inputs"])):
                n = {k.split(".")[1]: file[k] for k in file.files if k.startswith(f"{i}.")}
                if "data" in n:
                    n["weight"] = csr_array((n["data"], n["columns"], n["starts"]), n["size"])
                self.nodes.append((OPERATIONS[op], n, inputs[inputs >= 0]))

    def __call__(self, observation):
        if self.parts:
            parts = [(np.asarray(observation[key], np.float32), axes) for key, axes in self.parts]
            rows = [x.reshape(*x.shape[: x.ndim - axes], -1) for x, axes in parts]
            observation = np.concatenate(rows, -1)
        x = np.asarray(observation, np.float32)
        values = [np.moveaxis(x.reshape(-1, *self.shape), 0, -1)]
        for operation, n, inputs in self.nodes:
            values.append(operation(n, *(values[i] for i in inputs)))
        many = x.shape[: x.ndim - len(self.shape)]
        rows = (np.moveaxis(values[v], -1, 0).reshape((*many, *s)) for v, s in self.outputs)
        return self.named(*rows)
