"""The paper on multimodal-prior-guided importance sampling, as a strategy: scores, reliability gate, placement, protection."""
