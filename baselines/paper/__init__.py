"""The paper figure by figure: its claims, computed anew and judged."""
