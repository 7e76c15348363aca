"""Loading a saved SB3 model whose algorithm is not known beforehand."""

import io
import json
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.agents.pretrained import pretrained_names
from sb3_quad.agents.statistics import STATISTICS
from sb3_quad.agents.tensors import ENDING, read_tensors
from sb3_quad.agents.unpickle import WAY_OUT, held, unpickle
from sb3_quad.base.errors import ConfigError, did_you_mean, raised_as
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.process import trusted
from sb3_quad.base.trees import walk
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.yaml_files import read_yaml
from sb3_quad.envs.batch_env import quadcopter_spaces
from sb3_quad.envs.simulation.settings import KEY

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)

# The module of the saved policy class tells the algorithm's family.
_FAMILIES = {
    "stable_baselines3.common.policies": "PPO",
    "stable_baselines3.sac.policies": "SAC",
    "stable_baselines3.td3.policies": "TD3",
}
# This package's algorithms with their family, and a setting that only they save. Otherwise their
# zips are those of the stock algorithm.
_OURS = {
    "PPOBC": ("PPO", "bc_coef"),
    "DAgger": ("PPO", "beta"),
    "APG": ("PPO", "continue_flights"),
}
# ``predict`` needs only these of an agent's pickles.
_TO_FLY = ("action_space", "observation_space", "policy_class", "policy_kwargs", STATISTICS)
# SB3 pickles NumPy numbers; these prefixes mark them.
_NUMBERS = ("<class 'numpy.int", "<class 'numpy.float")
# The others become None, or these values where SB3 cannot load None.
_STAND_INS = {"clip_range": 0.0, "learning_rate": 0.0, "train_freq": 1}
# SB3 and this package never save these, and loading them would import the modules that they name.
_NEVER_READ = ("env", "expert", "_labeller")
DAMAGED = "not a complete SB3 zip"
WRAPPERS = ("env_wrapper", "vec_env_wrapper", "frame_stack")
# The variables that SB3 saves besides policies and optimisers. Loading others would set any
# attribute.
_VARIABLES = {"ent_coef_tensor", "log_ent_coef"}
_VARIABLE_FILES = ("pytorch_variables.pth", "tensors.pth")
# Largest number of values in spaces and in the policy's keywords; each layer takes time.
_LARGEST = 1000
# Keywords that do not affect a policy's layers, and that not all policies or devices accept.
_WITHOUT_SIZE = ("device", "optimizer_class", "optimizer_kwargs", "squash_output", "use_sde")


def saved_data(path: StrPath | io.BytesIO, where: str = "") -> StrDict:
    """Return the attributes of the model in an SB3 ``.zip``, or in a safetensors file, as in its
    JSON.

    Attributes that are pickled there stay pickled.

    :param where: what messages call the file; empty: its path.
    :raises ConfigError: a missing file, or one that is not a complete SB3 zip.
    """
    where = where or f"model {path}"
    if str(path).endswith(ENDING):
        return read_tensors(str(path))[0]
    if not isinstance(path, io.BytesIO):
        if Path(path).is_dir():
            raise ConfigError(f"{where}: no run with an agent in this folder")
        if not Path(path).is_file():
            guess = did_you_mean(path, pretrained_names())
            raise ConfigError(f"{where}: no such file; {guess}".rstrip("; "))
    # A damaged archive may raise anything.
    with raised_as(ConfigError, f"{where}: {DAMAGED}"), _open(path, where) as archive:
        return dict(json.loads(archive.read("data")))


def _open(file: Any, where: str) -> zipfile.ZipFile:
    """Open a zip whose parts need no more memory than its size, as SB3 and PyTorch write it.

    :raises ConfigError: parts are compressed, or overlap.
    """
    archive = zipfile.ZipFile(file)
    parts = archive.infolist()
    size = sum(part.file_size for part in parts)
    if size > archive.start_dir or any(part.compress_type for part in parts):
        raise ConfigError(f"{where}: is compressed, as no zip of SB3 is; pack it with zip -0")
    return archive


def saved_algorithm(path: StrPath) -> str:
    """Return the name of the algorithm that made an SB3 ``.zip``.

    It is PPO, A2C, SAC, TD3 or DDPG; or PPOBC, DAgger or APG of this package. A zip does not
    name its algorithm; the policy class and the settings in it tell which one it is.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, or a policy of an
        unknown family.
    """
    data = saved_data(path)
    with raised_as(ConfigError, f"model {path}: {DAMAGED}"):
        module = str(data["policy_class"]["__module__"])
    if module not in _FAMILIES:
        raise ConfigError(
            f"model {path}: its policy is of {module}, known are {', '.join(sorted(_FAMILIES))}"
        )
    family = _FAMILIES[module]
    for name, (stock, setting) in _OURS.items():
        if family == stock and setting in data:
            return name
    # A2C and DDPG have the policy classes of PPO and TD3.
    if family == "PPO" and "n_epochs" not in data:
        return "A2C"
    if family == "TD3" and data.get("policy_delay") == 1:
        return "DDPG"
    return family


def load_zip(
    algorithm: type[Algorithm],
    path: StrPath | io.BytesIO,
    to_fly: bool = False,
    where: str = "",
    **kwargs: Any,
) -> Algorithm:
    """Return ``algorithm.load(path, **kwargs)``, without running any code from the file.

    PyTorch reads the weights with ``weights_only``; :func:`unpickle` reads the pickles that are
    saved with them. If the user has declared files :func:`trusted`, SB3 reads everything.

    :param to_fly: load for ``predict`` only. Schedules, noise and the like, which may be functions,
        are then not read at all.
    :param where: what messages call the file; empty: its path.
    :raises ConfigError: a missing or damaged file, or one that may run code.
    """
    where = where or f"model {path}"
    # SB3 does not unpickle what is in ``custom_objects``.
    objects: StrDict = {}
    data = {} if trusted() else saved_data(path, where)
    for key, entry in data.items():
        if key in _NEVER_READ:
            objects[key] = None
        elif isinstance(entry, dict) and ":serialized:" in entry:
            is_number = str(entry.get(":type:")).startswith(_NUMBERS)
            if to_fly and key not in _TO_FLY and not is_number:
                objects[key] = _STAND_INS.get(key)
            else:
                objects[key] = unpickle(entry[":serialized:"], f"{where}: its {key}")
    # A zip with parts that do not fit may raise anything.
    with raised_as(ConfigError, f"{where}: cannot be loaded"), warnings.catch_warnings():
        # SB3 mistakes the buffer of n-step returns, its own choice, for the user's.
        warnings.filterwarnings("ignore", "`n_steps=")
        # SB3 reads the layers of older zips, too.
        warnings.filterwarnings("ignore", "As shared layers")
        if data:
            with _open(path, where) as archive:
                _check_parameters(archive, data | objects, where)
        return algorithm.load(path, custom_objects=objects, **kwargs)


def _check_parameters(archive: zipfile.ZipFile, data: StrDict, where: str) -> None:
    """Check the parameters and the policy in a zip, since neither PyTorch nor the policy's class
    limits their size.
    """
    for part in archive.namelist():
        if not part.endswith(".pth"):
            continue
        its = f"{where}: its {part}"
        with (
            raised_as(ConfigError, f"{its} is not what PyTorch saves since 1.6; {WAY_OUT}"),
            _open(archive.open(part), its) as weights,
        ):
            (name,) = [name for name in weights.namelist() if name.endswith("/data.pkl")]
            content = unpickle(weights.read(name), its)
        # SB3 sets variables by their names, on any part of the model.
        if part in _VARIABLE_FILES and content and content.keys() - _VARIABLES:
            raise ConfigError(
                f"{where}: holds variables that no algorithm has; "
                f"known are {', '.join(sorted(_VARIABLES))}"
            )
    # Half precision is the smallest format that somebody may have saved.
    _check_size(data, archive.getinfo("policy.pth").file_size // 2, where)


def _check_size(data: StrDict, most: int, where: str) -> None:
    """Check how many parameters a policy asks for, without making it.

    :param data: the attributes of its model, unpickled.
    :param most: the most parameters that its file can contain.
    """
    walk([data.get(key) for key in _TO_FLY], held, _LARGEST)
    given = data["policy_kwargs"]
    keywords = {key: given[key] for key in given if key not in _WITHOUT_SIZE}
    if keywords.get("n_critics", 2) > 100:
        raise ConfigError(f"{where}: asks for more than 100 critics")
    # Parameters on this device take no memory.
    meta = th.device("meta")
    sketch: Any = type("Sketch", (data["policy_class"],), {"device": meta})
    with meta:
        policy = sketch(data["observation_space"], data["action_space"], lambda _: 0.0, **keywords)
    asked = sum(parameter.numel() for parameter in policy.parameters())
    if asked > most:
        raise ConfigError(f"{where}: asks for {asked:,} parameters, its file holds fewer")


def _build_model(algorithm: Any, path: StrPath, device: str) -> Any:
    """Return the model of a stock algorithm in a safetensors file.

    :raises ConfigError: see :func:`.read_tensors`; or settings and parameters that do not fit.
    """
    data, tensors = read_tensors(path)
    with raised_as(ConfigError, f"model {path}: cannot be loaded"):
        keywords = parse_mapping(data["policy_kwargs"], "policy_kwargs")
        model = algorithm("MlpPolicy", None, policy_kwargs=keywords, _init_setup_model=False)
        model.device = th.device(device)
        # A policy cannot observe more numbers than its file has weights.
        most = sum(tensor.numel() for tensor in tensors.values())
        seen = min(data["observation_size"], most)
        model.observation_space, model.action_space = quadcopter_spaces(seen)
        _check_size(vars(model), most, f"model {path}")
        # Nothing is stored here, or trained.
        model.n_envs = model.buffer_size = 1
        model.target_entropy = 0.0
        model._setup_model()
        model.policy.load_state_dict(tensors)
    if KEY in data:
        setattr(model, KEY, data[KEY])
    return model


def load_model(path: StrPath, device: str = "cpu") -> BaseAlgorithm:
    """Return the model in an SB3 ``.zip``, or in a safetensors file, ready for ``predict``.

    It may be of PPO, A2C, SAC, TD3 or DDPG of Stable-Baselines3, or of this package. Its
    ``vec_normalize`` has the statistics of VecNormalize that it was trained with, if any.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, a policy of an unknown
        family, parameters that are not finite, or a file that may run code.
    """
    name = saved_algorithm(path)
    # ``predict`` of this package's algorithms is that of the stock ones.
    if name in _OURS:
        name, _ = _OURS[name]
    algorithm: type[BaseAlgorithm] = getattr(stable_baselines3, name)
    model: BaseAlgorithm
    if str(path).endswith(ENDING):
        model = _build_model(algorithm, path, device)
    else:
        model = load_zip(algorithm, path, to_fly=True, device=device)
    for parameter, tensor in model.policy.state_dict().items():
        if not th.isfinite(tensor).all():
            raise ConfigError(
                f"model {path}: {parameter} contains NaN or infinity; the model is unusable"
            )
    # A zip of this package contains all that its agent needs.
    if not {KEY, STATISTICS} & vars(model).keys():
        setattr(model, STATISTICS, _statistics_beside(path))
    return model


def _statistics_beside(path: StrPath) -> VecNormalize | None:
    """Return what is in the ``vecnormalize.pkl`` that rl_zoo3 keeps in a folder next to a zip.

    None: the agent was trained without statistics.

    :raises ConfigError: a file that cannot be read, or no file although the run had statistics.
    """
    for file in Path(path).parent.glob("*/vecnormalize.pkl"):
        statistics = unpickle(file.read_bytes(), str(file))
        if not isinstance(statistics, VecNormalize):
            raise ConfigError(f"{file}: holds no VecNormalize")
        return statistics
    refuse_settings(path, ("normalize",))
    return None


def refuse_settings(path: StrPath, keys: Sequence[str] = WRAPPERS) -> None:
    """Check that an agent was trained without some settings, according to its run folder.

    A zip of this package with flight settings always was.

    :param keys: keys of settings files, of this package and of rl_zoo3.
    :raises ConfigError: it was trained with one of them.
    """
    if KEY in saved_data(path):
        return
    for config in Path(path).parent.glob("*/config.yml"):
        used = ", ".join(filter(read_yaml(config).get, keys))
        if used:
            raise ConfigError(
                f"{path}: was trained with {used} (see {config}), without which it flies otherwise"
            )
