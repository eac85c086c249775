"""E. coli and P. putida, by the names that tests call their curves by."""

from envs.coculture.pair import PairConfig

__all__ = ["EQUAL_RATES_C", "LAG_P_MIN", "PAIR", "T_MAX", "T_MIN", "e_coli_rate", "p_putida_rate", "steady_production"]

PAIR = PairConfig()
e_coli_rate, p_putida_rate, steady_production = PAIR.curve(0), PAIR.curve(1), PAIR.production
T_MIN, T_MAX, EQUAL_RATES_C, LAG_P_MIN = 29.0, 36.0, PAIR.even_c, 60.0
