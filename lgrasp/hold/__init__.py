"""Does a grasp hold? A quasi-static simulation of a compliant hand and a free object, made to test very many grasps."""
