"""Reading the model in an SB3 zip whose algorithm is not known beforehand.

The zip is read once, as data: JSON, the pickles in it (:mod:`.pickles`) and the weights. Then it is
written again from what was read, and SB3 loads that copy. So SB3 and PyTorch never open the file
of a stranger.
"""

import base64
import io
import json
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import save_to_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.agents.pickles import read_pickle
from sb3_quad.agents.pretrained import pretrained_names
from sb3_quad.algorithms.chain import STATISTICS
from sb3_quad.base.errors import ConfigError, did_you_mean, raised_as
from sb3_quad.base.files import read_bytes
from sb3_quad.base.process import trusted
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.yaml_files import read_yaml
from sb3_quad.envs.simulation.settings import KEY

# Algorithms by a setting that the ones after them do not save. Subclasses of SAC and TD3 are read
# as these.
_SETTINGS = {
    "SAC": "target_entropy",
    "TD3": "policy_delay",
    "PPOBC": "bc_coef",
    "DAgger": "beta",
    "APG": "continue_flights",
    "PPO": "n_epochs",
    "A2C": "gae_lambda",
}
# ``predict`` needs only these of an agent's pickles.
_TO_FLY = ("action_space", "observation_space", "policy_class", "policy_kwargs", STATISTICS)
# SB3 and this package never save these, and loading them would import the modules that they name.
_NEVER_READ = ("env", "expert", "_labeller")
WRAPPERS = ("env_wrapper", "vec_env_wrapper", "frame_stack")
# The variables that SB3 saves besides policies and optimisers.
_VARIABLES = {"ent_coef_tensor", "log_ent_coef"}
# The largest zip, in bytes.
_LARGEST = 2**28
# Keywords that do not affect a policy's layers, and that not all policies or devices accept.
_WITHOUT_SIZE = ("device", "optimizer_class", "optimizer_kwargs", "squash_output", "use_sde")


def saved_data(path: StrPath) -> StrDict:
    """Return the attributes of the model in an SB3 ``.zip``, as in its JSON.

    Attributes that are pickled there stay pickled.

    :raises ConfigError: a missing file, or one that is not a complete SB3 zip.
    """
    # A damaged archive may raise anything.
    with raised_as(ConfigError, f"model {path}: not a complete SB3 zip"):
        return _data(_open(path))


def saved_algorithm(path: StrPath) -> str:
    """Return the name of the algorithm that made an SB3 ``.zip``.

    It is PPO, A2C, SAC, TD3 or DDPG; or PPOBC, DAgger or APG of this package. A zip does not name
    its algorithm; the settings in it tell which one it is.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, or an unknown
        algorithm.
    """
    return _algorithm(saved_data(path))


def _algorithm(data: StrDict) -> str:
    # DDPG saves the settings of TD3.
    if data.get("policy_delay") == 1:
        return "DDPG"
    for name, setting in _SETTINGS.items():
        if setting in data:
            return name
    raise ConfigError(f"its algorithm is unknown; known are {', '.join(_SETTINGS)}")


def load_model(path: StrPath) -> BaseAlgorithm:
    """Return the model in an SB3 ``.zip``, ready for ``predict``.

    It may be of PPO, A2C, SAC, TD3 or DDPG of Stable-Baselines3, or of this package. Its
    ``vec_normalize`` has the statistics of VecNormalize that it was trained with, if any.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, an unknown algorithm,
        parameters that are not finite, or a file that may run code.
    """
    model: BaseAlgorithm = load_zip(None, path, device="cpu")
    for parameter, tensor in model.policy.state_dict().items():
        if not th.isfinite(tensor).all():
            raise ConfigError(
                f"model {path}: {parameter} contains NaN or infinity; the model is unusable"
            )
    # A zip of this package contains all that its agent needs.
    if not {KEY, STATISTICS} & vars(model).keys():
        setattr(model, STATISTICS, _statistics_beside(path, model))
    return model


def load_zip(algorithm: Any, source: StrPath | io.BytesIO, where: str = "", **kwargs: Any) -> Any:
    """Return ``algorithm.load(source, **kwargs)``, without running any code from the zip.

    If the user has declared files :func:`trusted`, SB3 reads everything.

    :param algorithm: its class; None: the stock algorithm for ``predict`` only. Schedules and
        noise, which may be functions, are then missing.
    :param where: what messages call the zip; empty: its path.
    :raises ConfigError: a missing or damaged file, or one that may run code.
    """
    where = where or f"model {source}"
    with raised_as(ConfigError, f"{where}: not a complete SB3 zip"), warnings.catch_warnings():
        # SB3 mistakes the buffer of n-step returns, its own choice, for the user's; and it reads
        # the layers of older zips, too.
        warnings.filterwarnings("ignore", "`n_steps=|As shared layers")
        archive = _open(source)
        data = _data(archive)
        to_fly = algorithm is None
        if to_fly:
            # ``predict`` of this package's algorithms is that of PPO.
            algorithm = getattr(stable_baselines3, _algorithm(data), stable_baselines3.PPO)
        content: Any = archive.fp
        if not trusted():
            content, kwargs["custom_objects"] = _copy(archive, data, to_fly, where)
        content.seek(0)
        return algorithm.load(content, **kwargs)


def _read_file(path: Path) -> io.BytesIO:
    """Return the content of a file.

    :raises ConfigError: it is missing, or too large.
    """
    if not path.is_file():
        guess = did_you_mean(path, pretrained_names())
        problem = f"model {path}: no such file, or no agent in this folder; {guess}"
        raise ConfigError(problem.rstrip("; "))
    return io.BytesIO(read_bytes(path, _LARGEST))


def _open(source: StrPath | io.BytesIO) -> zipfile.ZipFile:
    """Open a zip whose parts need no more memory than its size, as SB3 and PyTorch write it.

    :raises ConfigError: see :func:`_read_file`.
    :raises ValueError: it begins with something else, or parts are compressed, or overlap.
    """
    content = source
    if not isinstance(content, io.BytesIO):
        content = _read_file(Path(content))
    # Before version 1.6, PyTorch wrote files of another kind.
    if not content.getvalue().startswith(b"PK\x03\x04"):
        raise ValueError("it does not begin as a zip")
    archive = zipfile.ZipFile(content)
    if sum(part.file_size for part in archive.infolist()) > archive.start_dir:
        raise ValueError("is compressed, as no zip of SB3 is; pack it with zip -0")
    return archive


def _data(archive: zipfile.ZipFile) -> StrDict:
    text = archive.read("data")
    # Brackets take 20 times as much memory as text.
    if text.count(b"[") + text.count(b"{") > 100_000:
        raise ValueError("its data holds too much")
    return dict(json.loads(text))


def _copy(
    archive: zipfile.ZipFile, data: StrDict, to_fly: bool, where: str
) -> tuple[io.BytesIO, StrDict]:
    """Return a zip that has been written again with the weights in another one, and the model's
    attributes for SB3's ``custom_objects``.
    """
    kept = {}
    for key, entry in data.items():
        if key in _NEVER_READ:
            continue
        if isinstance(entry, dict) and ":serialized:" in entry:
            if to_fly and key not in _TO_FLY:
                continue
            with _safely(f"{where}: its {key}"):
                entry = read_pickle(base64.b64decode(entry[":serialized:"]))
        kept[key] = entry
    tensors = {}
    for part in archive.namelist():
        name, _, ending = part.rpartition(".")
        if ending == "pth":
            with _safely(f"{where}: its {part}"):
                tensors[name] = _tensors(archive.read(part))
    # The second name is that of SB3 before 0.9.
    variables = tensors.pop("pytorch_variables", None) or tensors.pop("tensors", {})
    # SB3 would set variables of other names on any object.
    if variables.keys() - _VARIABLES:
        raise ValueError("it holds variables that no algorithm has")
    # Half precision is the smallest format. Without gSDE, layers may be a little larger, too.
    _check_size(kept, archive.getinfo("policy.pth").file_size // 2)
    copy = io.BytesIO()
    save_to_zip_file(copy, dict.fromkeys(kept), tensors, variables)
    return copy, kept


def _safely(its: str) -> Any:
    way_out = "if you trust its maker, add --trust, or set SB3_QUAD_TRUST=1"
    return raised_as(ConfigError, f"{its} cannot be read; {way_out}")


def _tensors(content: bytes) -> Any:
    """Return what PyTorch has saved."""
    weights = _open(io.BytesIO(content))
    # PyTorch writes the pickle first, then the folder with the tensors.
    name = weights.namelist()[0]
    folder = name.removesuffix(".pkl")
    return read_pickle(weights.read(name), lambda part: weights.read(f"{folder}/{part}"))


def _check_size(data: StrDict, most: int) -> None:
    """Check how many parameters a policy asks for, without making it.

    :param data: the attributes of its model.
    :param most: the most parameters that its file can hold.
    :raises ValueError: there are too many, or too many layers, since each takes time.
    """
    given = data["policy_kwargs"]
    if len(str(given)) > 10_000 or given.get("n_critics", 2) > 100:
        raise ValueError("its policy_kwargs are too large")
    keywords = {key: given[key] for key in given if key not in _WITHOUT_SIZE}
    # Parameters on this device take no memory.
    meta = th.device("meta")
    sketch: Any = type("Sketch", (data["policy_class"],), {"device": meta})
    with meta:
        policy = sketch(data["observation_space"], data["action_space"], lambda _: 0.0, **keywords)
    asked = sum(parameter.numel() for parameter in policy.parameters())
    if asked > most:
        raise ValueError(f"it asks for {asked:,} parameters, which its file does not hold")


def _statistics_beside(path: StrPath, model: BaseAlgorithm) -> VecNormalize | None:
    """Return the statistics in a file near a zip.

    rl_zoo3 keeps ``vecnormalize.pkl`` in a folder next to the zip, SB3's pages and the Hub
    ``vec_normalize.pkl`` in the zip's own folder, and SB3's CheckpointCallback
    ``rl_model_vecnormalize_600_steps.pkl`` for ``rl_model_600_steps.zip``. None: the agent was
    trained without statistics.

    :raises ConfigError: a file that cannot be read or does not fit; several, or one of another
        step; or no file although the run had statistics.
    """
    zip_file = Path(path)
    files = sorted(zip_file.parent.glob("*/vecnormalize.pkl"))
    files += [file for file in zip_file.parent.glob("*.pkl") if "normalize" in file.stem.lower()]
    prefix, _, step = zip_file.stem.removesuffix("_steps").rpartition("_")
    same = zip_file.with_name(f"{prefix}_vecnormalize_{step}_steps.pkl")
    if same in files:
        files = [same]
    elif len(files) > 1 or any(file.stem.endswith("_steps") for file in files):
        raise ConfigError(
            f"{path}: which statistics are its own? Leave one vec_normalize.pkl there, of"
            f" {', '.join(file.name for file in files)}"
        )
    for file in files:
        with _safely(str(file)):
            statistics = read_pickle(_read_file(file).getvalue())
        if not isinstance(statistics, VecNormalize):
            raise ConfigError(f"{file}: holds no VecNormalize")
        ours, theirs = model.observation_space, statistics.observation_space
        if ours.shape != theirs.shape:
            raise ConfigError(f"{file}: is of observations {theirs.shape}, {path} of {ours.shape}")
        return statistics
    refuse_settings(path, ("normalize",))
    return None


def refuse_settings(path: StrPath, keys: Sequence[str] = WRAPPERS) -> None:
    """Check that an agent was trained without some settings, according to its run folder.

    :param keys: keys of settings files, of this package and of rl_zoo3.
    :raises ConfigError: it was trained with one of them.
    """
    for config in Path(path).parent.glob("*/config.yml"):
        used = ", ".join(filter(read_yaml(config).get, keys))
        if used:
            raise ConfigError(
                f"{path}: was trained with {used} (see {config}), without which it flies otherwise"
            )
