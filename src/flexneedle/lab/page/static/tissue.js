// Strength of a layer's colour, for all views.

const [SOFT, STIFF] = [1, 30]; // kPa

// From 0, for a soft layer, to 1, for a stiff one, by the logarithm of its shear modulus (kPa).
export const shadeOf = (modulus) => Math.log(Math.min(Math.max(modulus, SOFT), STIFF) / SOFT) / Math.log(STIFF / SOFT);
