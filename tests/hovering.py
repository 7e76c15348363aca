"""Policies that hover, and react to all that they see."""

import torch
from stable_baselines3 import PPO

from sb3_quad.agents.pretrained import pretrained_path


def teach_to_hover(model, std):
    """Give a new model of 64-64 units the weights of ``itm-recovery``; those of the inputs behind
    the 18 features are normal, with this standard deviation.
    """
    known = PPO.load(pretrained_path("itm-recovery"), device="cpu").policy
    with torch.no_grad():
        for new, old in zip(model.policy.parameters(), known.parameters(), strict=True):
            if new.shape == old.shape:
                new.copy_(old)
            elif new.dim() == 2:
                new.normal_(std=std)[:, :18] = old
